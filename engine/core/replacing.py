"""`dataclasses.replace` for the values of every frame, several times as fast: the fields of a class are looked up once.

A frame replaces some thirteen values. Where a class checks nothing when it is made, and its fields are all slots, the
compiled form copies these; otherwise the constructor runs, as with the standard library's.
"""

from typing import TYPE_CHECKING, NamedTuple, TypeVar

if TYPE_CHECKING:
    from dataclasses import replace as replace  # noqa: PLC0414 - exported
else:
    from dataclasses import fields
    from operator import attrgetter
    from types import MemberDescriptorType

    from engine.core.compiled import FramePath

    T = TypeVar("T")

    class _Fields(NamedTuple):
        """What the constructor of a dataclass takes, and how to read it; its slots where they may be copied."""

        names: tuple[str, ...]
        read: attrgetter
        slots: tuple[MemberDescriptorType, ...]

    _FIELDS: dict[type, _Fields] = {}

    def replace(value: T, /, **changes: object) -> T:
        """Return a new value of the same dataclass, of two fields or more, with some of them changed."""
        kind = value.__class__
        known = _FIELDS.get(kind) or _look_up(kind)
        compiled = FramePath.kernels
        if known.slots and compiled is not None:
            copy = compiled.replaced(value, known.names, known.slots, changes)
            if copy is not None:
                return copy
        return kind(**(dict(zip(known.names, known.read(value), strict=True)) | changes))

    def _look_up(kind: type) -> _Fields:
        names = tuple(field.name for field in fields(kind) if field.init)
        slots = tuple(getattr(kind, name, None) for name in names)
        is_plain = len(names) == len(fields(kind)) and not hasattr(kind, "__post_init__")
        is_copied = is_plain and all(isinstance(slot, MemberDescriptorType) for slot in slots)
        _FIELDS[kind] = _Fields(names, attrgetter(*names), slots if is_copied else ())
        return _FIELDS[kind]
