"""Where each setting stands: its section and key in the site's file, and whether an environment variable overrides it.

A group of settings is a :class:`Section`; each of its fields is one setting, and its name stands there alone.
"""

from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, TypeVar

from pydantic_settings import BaseSettings

PREFIX = "TIDEGATE_"
CONFIG = f"{PREFIX}CONFIG"
"""The variable that names the site's file (TOML)."""

T = TypeVar("T")
OVERRIDES: set[str] = set()
"""Every setting that the environment may override; filled where the groups are defined."""
_PLACES: dict[str, tuple[str, str]] = {}


class _FromEnvironment:
    """Marks a setting that the environment may override."""


@dataclass(frozen=True, slots=True)
class In:
    """Marks a setting that stands in another section of the file than its group."""

    section: str


Env = Annotated[T, _FromEnvironment()]
"""A setting that the environment may override: what differs between machines, and the times of the supervision."""


class Section(BaseSettings):
    """Base of a group of settings.

    Attributes
    ----------
    SECTION
        The section of the file that its settings stand in.
    KEY_PREFIX
        Beginning of their names that is left out there.
    """

    SECTION: ClassVar[str]
    KEY_PREFIX: ClassVar[str] = ""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:  # noqa: ANN401 - as pydantic declares it
        """Note the place of each setting that the class adds."""
        super().__pydantic_init_subclass__(**kwargs)
        for name in cls.__annotations__.keys() & cls.model_fields.keys():
            marks = cls.model_fields[name].metadata
            section = next((mark.section for mark in marks if isinstance(mark, In)), cls.SECTION)
            _PLACES[name] = (section, name.removeprefix(cls.KEY_PREFIX) if cls.KEY_PREFIX else name)
            if any(isinstance(mark, _FromEnvironment) for mark in marks):
                OVERRIDES.add(name)


def place_of(name: str) -> tuple[str, str]:
    """Return a setting's section in the file and its key there; an unknown one is looked for among the gate's."""
    return _PLACES.get(name, ("gate", name))


def setting_name(name: str) -> str:
    """Return the name that people know: the environment variable, or section and key in the file."""
    return f"{PREFIX}{name.upper()}" if name in OVERRIDES else ".".join(place_of(name))
