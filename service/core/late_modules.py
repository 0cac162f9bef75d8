"""Libraries that are loaded when one of their names is used first: an idle service has no use for them.

A module of ours imports such a library as any other. What it reads of it at its own import loads it: types of
annotations (`from __future__ import annotations`), classes that it derives from, constants made of it.
"""

import importlib.util
import sys
import threading
from collections.abc import Callable
from importlib.machinery import PathFinder
from types import ModuleType

_loading = threading.RLock()
"""A second thread waits until the first has loaded the library, and never sees half of one."""
_afterwards: dict[str, list[Callable[[], object]]] = {}


class _LateModule(ModuleType):
    """A module whose code runs when a name is read that it does not have yet."""

    def __getattr__(self, name: str) -> object:
        """Load the module, and return one of its names."""
        self.load()
        if name in self.__dict__:  # also where another thread has just loaded it
            found: object = self.__dict__[name]
            return found
        msg = f"module {self.__name__!r} has no attribute {name!r}"
        raise AttributeError(msg)

    def load(self) -> None:
        """Run the module's code, unless it has run or runs in this thread."""
        with _loading:
            spec = self.__spec__
            if self.__dict__["__is_late__"] and spec is not None and spec.loader is not None:
                self.__dict__["__is_late__"] = False
                if spec.submodule_search_locations is not None:
                    self.__path__ = spec.submodule_search_locations
                try:
                    spec.loader.exec_module(self)
                except BaseException:
                    self.__dict__["__is_late__"] = True
                    raise
                for work in _afterwards.pop(self.__name__, ()):
                    work()


def load_when_used(*names: str) -> None:
    """Have these libraries loaded at their first use, unless they are already; call it before they are imported.

    A part of a library is named behind it.

    Raises
    ------
    ModuleNotFoundError
        One of them is not installed.
    """
    for name in names:
        if name in sys.modules:
            continue
        whole, _, part = name.rpartition(".")
        parent = sys.modules.get(whole)
        places = None if parent is None or parent.__spec__ is None else parent.__spec__.submodule_search_locations
        spec = PathFinder.find_spec(name, places)
        if spec is None:
            raise ModuleNotFoundError(name=name)
        module = _LateModule(name)
        module.__dict__.update(importlib.util.module_from_spec(spec).__dict__, __is_late__=True)
        module.__dict__.pop("__path__", None)  # an import of a submodule then loads the library first
        sys.modules[name] = module
        if parent is not None:
            setattr(parent, part, module)


def load_now() -> None:
    """Load what is still to be loaded, before a session: loaded in one, a library may keep this process from answering.

    The interpreter's lock is held while a library of tens of megabytes is mapped, from a slow disk for a second.
    """
    for module in list(sys.modules.values()):
        if isinstance(module, _LateModule):
            module.load()


def when_loaded(name: str, work: Callable[[], object]) -> None:
    """Run ``work`` as soon as a library is loaded: now, unless it is to be loaded when used."""
    with _loading:
        module = sys.modules.get(name)
        if isinstance(module, _LateModule) and module.__dict__["__is_late__"]:
            _afterwards.setdefault(name, []).append(work)
            return
    work()
