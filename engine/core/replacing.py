"""`dataclasses.replace` for the values of every frame, several times as fast: the fields of a class are looked up once.

A frame replaces some ten values. Where a class checks nothing when it is made, and its fields are all slots, the
compiled form copies these; otherwise the constructor runs, as with the standard library's.
"""

from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from dataclasses import replace as replace  # noqa: PLC0414 - exported
else:
    from dataclasses import fields
    from operator import attrgetter
    from types import MemberDescriptorType

    from engine.core.compiled import FramePath

    T = TypeVar("T")
    _READ: dict[type, tuple[tuple[str, ...], attrgetter]] = {}
    """What the constructor of a dataclass takes, and how to read it."""
    _SLOTS: dict[type, tuple[tuple[str, ...], tuple[MemberDescriptorType, ...]]] = {}
    """The fields of the classes that may be copied, and their slots."""

    def constructed(value: T, /, **changes: object) -> T:
        """Return a new value of the same dataclass, of two fields or more, by its constructor."""
        kind = value.__class__
        names, read = _READ.get(kind) or _look_up(kind)
        return kind(**(dict(zip(names, read(value), strict=True)) | changes))

    def _look_up(kind: type) -> tuple[tuple[str, ...], attrgetter]:
        names = tuple(field.name for field in fields(kind) if field.init)
        slots = tuple(getattr(kind, name, None) for name in names)
        is_plain = len(names) == len(fields(kind)) and not hasattr(kind, "__post_init__")
        if is_plain and all(isinstance(slot, MemberDescriptorType) for slot in slots):
            _SLOTS[kind] = names, slots
        _READ[kind] = names, attrgetter(*names)
        return _READ[kind]

    replace = constructed if FramePath.kernels is None else FramePath.kernels.replacer(_SLOTS, constructed)
