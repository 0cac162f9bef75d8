"""One pass over a DICOM data set's bytes that keeps the wanted elements and steps over all others.

Strict where a lenient reader would guess: every length must end inside what it is in, tags rise (so none stands twice),
and depth, items and elements are bounded before anything is built (PS3.5, 7.1 to 7.5). The work is bounded by the
bounds, not by what the file says. Nothing of an element that is not wanted is decoded, private ones included.
"""

import struct
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

from service.plans.errors import PlanBoundError, PlanFormatError, PlanTruncatedError
from service.plans.tags import Wanted, named

Item: TypeAlias = dict[int, bytes | list["Item"]]

MAX_ELEMENTS = 300_000
"""Elements that are stepped through, items included. The largest scanned-beam plans have some ten thousand."""
MAX_ITEMS = 20_000
MAX_DEPTH = 16
"""Sequences inside sequences; a plan has five."""
MAX_VALUE_BYTES = 1_024
"""Of an element that is read: all are names, numbers and codes."""

UNDEFINED = 0xFFFFFFFF
ITEM, ITEM_END, SEQUENCE_END = 0xFFFEE000, 0xFFFEE00D, 0xFFFEE0DD
DELIMITERS = 0xFFFE
LONG = frozenset({b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"})
SHORT = frozenset(
    {b"AE", b"AS", b"AT", b"CS", b"DA", b"DS", b"DT", b"FD", b"FL", b"IS", b"LO", b"LT", b"PN", b"SH", b"SL", b"SS"}
    | {b"ST", b"TM", b"UI", b"UL", b"US"}
)
NOTHING: Wanted = {}


@dataclass(frozen=True, slots=True, kw_only=True)
class Form:
    """How elements are written: byte order, and whether their representation is said."""

    is_implicit: bool
    tag: struct.Struct
    short: struct.Struct
    long: struct.Struct


def _form(order: str, *, is_implicit: bool) -> Form:
    return Form(
        is_implicit=is_implicit,
        tag=struct.Struct(f"{order}HH"),
        short=struct.Struct(f"{order}H"),
        long=struct.Struct(f"{order}I"),
    )


IMPLICIT_LITTLE = _form("<", is_implicit=True)
EXPLICIT_LITTLE = _form("<", is_implicit=False)
EXPLICIT_BIG = _form(">", is_implicit=False)


class Head(NamedTuple):
    """What stands before a value: whose it is, and from where it goes how far."""

    tag: int
    representation: bytes
    start: int
    length: int


@dataclass(slots=True, kw_only=True)
class Walk:
    """Steps through one data set; counts what it has stepped over."""

    data: bytes
    left: int = field(default=MAX_ELEMENTS)

    def dataset(self, start: int, form: Form, wanted: Wanted) -> Item:
        """Read the data set that goes from here to the end of the bytes."""
        return self._item(start, len(self.data), form, wanted, depth=0, is_open=False)[0]

    def head(self, at: int, end: int, form: Form) -> Head:
        """Read what stands before a value."""
        if end - at < 8:
            raise _cut(f"{end - at} bytes are left where an element begins", None)
        group, element = form.tag.unpack_from(self.data, at)
        tag = group << 16 | element
        if form.is_implicit or group == DELIMITERS:
            return Head(tag, b"", at + 8, form.long.unpack_from(self.data, at + 4)[0])
        representation = self.data[at + 4 : at + 6]
        if representation in SHORT:
            return Head(tag, representation, at + 8, form.short.unpack_from(self.data, at + 6)[0])
        if representation not in LONG:
            msg = f"{named(tag)} has no value representation that DICOM knows"
            raise PlanFormatError(msg, field=named(tag), value=repr(representation), bound="one of PS3.5, 6.2")
        if end - at < 12:
            raise _cut("the file ends before the element's length", tag)
        return Head(tag, representation, at + 12, form.long.unpack_from(self.data, at + 8)[0])

    def _item(self, at: int, end: int, form: Form, wanted: Wanted, *, depth: int, is_open: bool) -> tuple[Item, int]:
        """Read elements up to an end that is known, or to the delimiter where it is open; returns where that was."""
        found: Item = {}
        last = -1
        while at < end:
            head = self.head(at, end, form)
            self._count(head.tag)
            if is_open and head.tag == ITEM_END:
                return found, head.start
            if head.tag <= last or head.tag >> 16 == DELIMITERS:
                msg = f"{named(head.tag)} stands twice, or out of its order"
                raise PlanFormatError(msg, field=named(head.tag), bound="tags rise within a data set")
            last = head.tag
            value, at = self._value(head, end, form, wanted.get(head.tag), depth)
            if value is not None:
                found[head.tag] = value
        if is_open:
            raise _cut("the file ends inside an item", ITEM)
        return found, at

    def _value(
        self, head: Head, end: int, form: Form, wanted: str | Wanted | None, depth: int
    ) -> tuple[bytes | list[Item] | None, int]:
        """Return the value where it is wanted, and where the next element begins."""
        if head.length != UNDEFINED and head.length > end - head.start:
            raise _cut(f"{head.length} bytes are told, {end - head.start} are there", head.tag)
        if isinstance(wanted, str):
            return self._plain(head, wanted), head.start + head.length
        if wanted is None and head.length != UNDEFINED:
            return None, head.start + head.length
        if head.representation not in {b"SQ", b"UN", b""}:
            msg = f"{named(head.tag)} is no sequence, and is written as one"
            raise PlanFormatError(msg, field=named(head.tag), value=head.representation.decode(), bound="SQ")
        # What somebody kept as unknown is written in the form that says nothing (PS3.5, 6.2.2).
        inner = IMPLICIT_LITTLE if head.representation == b"UN" else form
        items, at = self._sequence(head, end, inner, NOTHING if wanted is None else wanted, depth + 1)
        return None if wanted is None else items, at

    def _plain(self, head: Head, representation: str) -> bytes:
        if head.representation not in {representation.encode(), b"UN", b""} or head.length == UNDEFINED:
            value = "an undefined length" if head.length == UNDEFINED else head.representation.decode()
            msg = f"{named(head.tag)} is not written as {representation}"
            raise PlanFormatError(msg, field=named(head.tag), value=value, bound=representation)
        if head.length > MAX_VALUE_BYTES:
            raise _too_much(f"{head.length} bytes", f"at most {MAX_VALUE_BYTES} bytes", head.tag)
        return self.data[head.start : head.start + head.length]

    def _sequence(self, head: Head, end: int, form: Form, wanted: Wanted, depth: int) -> tuple[list[Item], int]:
        if depth > MAX_DEPTH:
            raise _too_much("one sequence more", f"at most {MAX_DEPTH} inside each other", head.tag)
        is_open = head.length == UNDEFINED
        at, end = head.start, end if is_open else head.start + head.length
        items: list[Item] = []
        while at < end:
            inner = self.head(at, end, form)
            self._count(head.tag)
            if is_open and inner.tag == SEQUENCE_END:
                return items, inner.start
            if inner.tag != ITEM:
                msg = f"{named(head.tag)} holds {named(inner.tag)} where an item must begin"
                raise PlanFormatError(msg, field=named(head.tag), value=named(inner.tag), bound="an item")
            if len(items) == MAX_ITEMS:
                raise _too_much(f"more than {MAX_ITEMS} items", f"at most {MAX_ITEMS}", head.tag)
            item, at = self._one(inner, end, form, wanted, depth)
            items.append(item)
        if is_open:
            raise _cut("the file ends inside a sequence", head.tag)
        return items, at

    def _one(self, head: Head, end: int, form: Form, wanted: Wanted, depth: int) -> tuple[Item, int]:
        """Read one item of a sequence; one whose length is known and of which nothing is wanted is stepped over."""
        if head.length == UNDEFINED:
            return self._item(head.start, end, form, wanted, depth=depth, is_open=True)
        if head.length > end - head.start:
            raise _cut(f"{head.length} bytes are told, {end - head.start} are there", head.tag)
        stop = head.start + head.length
        return self._item(head.start, stop, form, wanted, depth=depth, is_open=False) if wanted else ({}, stop)

    def _count(self, tag: int) -> None:
        self.left -= 1
        if self.left < 0:
            raise _too_much(f"more than {MAX_ELEMENTS} elements", f"at most {MAX_ELEMENTS} in a file", tag)


def _cut(why: str, tag: int | None) -> PlanTruncatedError:
    return PlanTruncatedError(
        f"the file is cut off or damaged: {why}",
        field="body" if tag is None else named(tag),
        value=why,
        bound="as long as it says",
    )


def _too_much(value: str, bound: str, tag: int) -> PlanBoundError:
    return PlanBoundError(
        f"{named(tag)} is more than any plan needs: {value}", field=named(tag), value=value, bound=bound
    )
