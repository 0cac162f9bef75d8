"""The DICOM file around a data set: preamble, meta information, transfer syntax, inflating (PS3.10, 7.1; PS3.5, A).

One pass over the bytes of a DICOM data set that returns the selected elements and skips all others.

The reader is strict: every length must end inside its container, tags must rise (so no element occurs twice);
depth, items and elements are limited before anything is allocated (PS3.5, 7.1 to 7.5). These limits bound the work,
not the lengths in the file. Elements outside the selection, private ones included, are not decoded.
"""

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

from service.planning.rt_plan.errors import PlanBoundError, PlanFormatError, PlanTruncatedError
from service.planning.rt_plan.tags import META, Tag, TagSelection, named, tag_number

Item: TypeAlias = dict[int, bytes | list["Item"]]

MAX_ELEMENTS = 300_000
"""Elements in a file, items included. The largest scanned-beam plans have about ten thousand."""
MAX_ITEMS = 20_000
MAX_DEPTH = 16
"""Nesting depth of sequences; a plan has five."""
MAX_VALUE_BYTES = 1_024
"""Length of a selected element; all are names, numbers and codes."""

UNDEFINED = 0xFFFFFFFF
ITEM, ITEM_END, SEQUENCE_END = 0xFFFEE000, 0xFFFEE00D, 0xFFFEE0DD
DELIMITERS = 0xFFFE
LONG = frozenset({b"OB", b"OD", b"OF", b"OL", b"OV", b"OW", b"SQ", b"SV", b"UC", b"UN", b"UR", b"UT", b"UV"})
SHORT = frozenset(
    {b"AE", b"AS", b"AT", b"CS", b"DA", b"DS", b"DT", b"FD", b"FL", b"IS", b"LO", b"LT", b"PN", b"SH", b"SL", b"SS"}
    | {b"ST", b"TM", b"UI", b"UL", b"US"}
)
NOTHING: TagSelection = {}
PREAMBLE_BYTES = 128
PREFIX = b"DICM"
META_GROUP = 0x0002
MAX_META_BYTES = 65_536
MAX_INFLATED_BYTES = 33_554_432
"""32 MiB, the largest inflated data set. Zeros deflate by a factor of 1000."""
DEFLATED = "1.2.840.10008.1.2.1.99"
OTHER_FORMATS = {
    b"\xff\xd8\xff": "a JPEG picture",
    b"\x89PNG": "a PNG picture",
    b"PK\x03\x04": "a ZIP archive",
    b"\x1f\x8b": "a gzip archive",
    b"%PDF": "a PDF document",
    b"{": "JSON",
    b"[": "JSON",
    b"<": "XML",
}
"""First bytes of other file formats, named in the refusal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Form:
    """Encoding of elements: byte order, and implicit or explicit value representation."""

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


class ElementHeader(NamedTuple):
    """Header of an element: tag, value representation (empty if implicit), offset and length of the value [bytes]."""

    tag: int
    representation: bytes
    start: int
    length: int


@dataclass(slots=True, kw_only=True)
class ElementReader:
    """Reads data sets from bytes; ``left`` is the number of elements that it may still read."""

    data: bytes
    left: int = field(default=MAX_ELEMENTS)

    def dataset(self, start: int, form: Form, selection: TagSelection) -> Item:
        """Read the data set from ``start`` to the end of the bytes.

        Raises
        ------
        PlanTruncatedError, PlanFormatError, PlanBoundError
            The bytes are cut off, break the encoding rules, or exceed a limit.
        """
        return self._item(start, len(self.data), form, selection, depth=0, is_open=False)[0]

    def head(self, at: int, end: int, form: Form) -> ElementHeader:
        """Read the header of the element at ``at``."""
        if end - at < 8:
            raise _cut(f"{end - at} bytes are left where an element begins", None)
        group, element = form.tag.unpack_from(self.data, at)
        tag = group << 16 | element
        if form.is_implicit or group == DELIMITERS:
            return ElementHeader(tag, b"", at + 8, form.long.unpack_from(self.data, at + 4)[0])
        representation = self.data[at + 4 : at + 6]
        if representation in SHORT:
            return ElementHeader(tag, representation, at + 8, form.short.unpack_from(self.data, at + 6)[0])
        if representation not in LONG:
            msg = f"{named(tag)} has an unknown value representation"
            raise PlanFormatError(msg, field=named(tag), value=repr(representation), bound="one of PS3.5, 6.2")
        if end - at < 12:
            raise _cut("the file ends before the element's length", tag)
        return ElementHeader(tag, representation, at + 12, form.long.unpack_from(self.data, at + 8)[0])

    def _item(
        self, at: int, end: int, form: Form, selection: TagSelection, *, depth: int, is_open: bool
    ) -> tuple[Item, int]:
        """Read elements up to ``end``, or to the delimiter of an open item; return them and the offset."""
        found: Item = {}
        last = -1
        while at < end:
            head = self.head(at, end, form)
            self._count(head.tag)
            if is_open and head.tag == ITEM_END:
                return found, head.start
            if head.tag <= last or head.tag >> 16 == DELIMITERS:
                msg = f"{named(head.tag)} occurs twice or out of order"
                raise PlanFormatError(msg, field=named(head.tag), bound="tags rise within a data set")
            last = head.tag
            value, at = self._value(head, end, form, selection.get(head.tag), depth)
            if value is not None:
                found[head.tag] = value
        if is_open:
            raise _cut("the file ends inside an item", ITEM)
        return found, at

    def _value(
        self, head: ElementHeader, end: int, form: Form, selection: str | TagSelection | None, depth: int
    ) -> tuple[bytes | list[Item] | None, int]:
        """Return the value if it is selected, and the offset of the next element."""
        if head.length != UNDEFINED and head.length > end - head.start:
            raise _cut(f"the declared length is {head.length} bytes, {end - head.start} are left", head.tag)
        if isinstance(selection, str):
            return self._plain(head, selection), head.start + head.length
        if selection is None and head.length != UNDEFINED:
            return None, head.start + head.length
        if head.representation not in {b"SQ", b"UN", b""}:
            msg = f"{named(head.tag)} is no sequence, but has an undefined length"
            raise PlanFormatError(msg, field=named(head.tag), value=head.representation.decode(), bound="SQ")
        # A sequence of representation UN is encoded as implicit little endian (PS3.5, 6.2.2).
        inner = IMPLICIT_LITTLE if head.representation == b"UN" else form
        items, at = self._sequence(head, end, inner, NOTHING if selection is None else selection, depth + 1)
        return None if selection is None else items, at

    def _plain(self, head: ElementHeader, representation: str) -> bytes:
        if head.representation not in {representation.encode(), b"UN", b""} or head.length == UNDEFINED:
            value = "an undefined length" if head.length == UNDEFINED else head.representation.decode()
            msg = f"{named(head.tag)} is not encoded as {representation}"
            raise PlanFormatError(msg, field=named(head.tag), value=value, bound=representation)
        if head.length > MAX_VALUE_BYTES:
            raise _too_large(f"{head.length} bytes", f"at most {MAX_VALUE_BYTES} bytes", head.tag)
        return self.data[head.start : head.start + head.length]

    def _sequence(
        self, head: ElementHeader, end: int, form: Form, selection: TagSelection, depth: int
    ) -> tuple[list[Item], int]:
        if depth > MAX_DEPTH:
            raise _too_large("one sequence more", f"at most {MAX_DEPTH} inside each other", head.tag)
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
                raise _too_large(f"more than {MAX_ITEMS} items", f"at most {MAX_ITEMS}", head.tag)
            item, at = self._sequence_item(inner, end, form, selection, depth)
            items.append(item)
        if is_open:
            raise _cut("the file ends inside a sequence", head.tag)
        return items, at

    def _sequence_item(
        self, head: ElementHeader, end: int, form: Form, selection: TagSelection, depth: int
    ) -> tuple[Item, int]:
        """Read one item of a sequence; skip it if its length is known and nothing of it is selected."""
        if head.length == UNDEFINED:
            return self._item(head.start, end, form, selection, depth=depth, is_open=True)
        if head.length > end - head.start:
            raise _cut(f"the declared length is {head.length} bytes, {end - head.start} are left", head.tag)
        stop = head.start + head.length
        return self._item(head.start, stop, form, selection, depth=depth, is_open=False) if selection else ({}, stop)

    def _count(self, tag: int) -> None:
        self.left -= 1
        if self.left < 0:
            raise _too_large(f"more than {MAX_ELEMENTS} elements", f"at most {MAX_ELEMENTS} in a file", tag)


def _cut(why: str, tag: int | None) -> PlanTruncatedError:
    return PlanTruncatedError(
        f"the file is cut off or damaged: {why}",
        field="body" if tag is None else named(tag),
        value=why,
        bound="as long as its lengths declare",
    )


def _too_large(value: str, bound: str, tag: int) -> PlanBoundError:
    return PlanBoundError(
        f"{named(tag)} exceeds the limit for plans: {value}", field=named(tag), value=value, bound=bound
    )


FORMS: Mapping[str, Form] = {
    "1.2.840.10008.1.2": IMPLICIT_LITTLE,
    "1.2.840.10008.1.2.1": EXPLICIT_LITTLE,
    DEFLATED: EXPLICIT_LITTLE,
    "1.2.840.10008.1.2.2": EXPLICIT_BIG,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Part10:
    """An opened DICOM file: ``data`` from ``start`` is the data set in encoding ``form``; ``meta`` its file meta."""

    data: bytes
    start: int
    form: Form
    meta: Item


def open_file(content: bytes) -> Part10:
    """Read the preamble and meta information of a DICOM file and inflate its data set.

    Raises
    ------
    PlanFormatError
        The content is no DICOM file, or its transfer syntax is not supported.
    PlanTruncatedError, PlanBoundError
        The content is cut off, or too large when inflated.
    """
    if content[PREAMBLE_BYTES : PREAMBLE_BYTES + len(PREFIX)] != PREFIX:
        raise _not_dicom(content)
    start = _meta_end(content)
    reader = ElementReader(data=content[:start])
    meta = reader.dataset(PREAMBLE_BYTES + len(PREFIX), EXPLICIT_LITTLE, META)
    syntax = plain_uid(meta, Tag.TRANSFER_SYNTAX)
    form = FORMS.get(syntax)
    if form is None:
        msg = f"the transfer syntax {syntax} is not supported"
        raise PlanFormatError(msg, field=named(Tag.TRANSFER_SYNTAX), value=syntax, bound=f"one of {', '.join(FORMS)}")
    if syntax == DEFLATED:
        return Part10(data=_inflate(content[start:]), start=0, form=form, meta=meta)
    return Part10(data=content, start=start, form=form, meta=meta)


def plain_uid(item: Item, tag: Tag) -> str:
    """Return a UID of the meta information; only its characters and length are checked."""
    raw = item.get(tag, b"")
    text = bytes(raw).rstrip(b"\0 ").decode("ascii", "replace") if isinstance(raw, bytes) else ""
    if not text or not set(text) <= set("0123456789.") or len(text) > 64:
        msg = f"the file's meta information has no valid {named(tag)}"
        raise PlanFormatError(msg, field=named(tag), value=f"{len(text)} characters", bound="a UID")
    return text


def _meta_end(content: bytes) -> int:
    """Return the offset after the last element of group 0002 (PS3.10, 7.1)."""
    reader = ElementReader(data=content)
    at, limit = PREAMBLE_BYTES + len(PREFIX), min(len(content), PREAMBLE_BYTES + MAX_META_BYTES)
    while at + 4 <= len(content) and EXPLICIT_LITTLE.tag.unpack_from(content, at)[0] == META_GROUP:
        head = reader.head(at, len(content), EXPLICIT_LITTLE)
        if head.length > limit - head.start:
            msg = "the file is cut off, or its meta information is too long"
            raise PlanTruncatedError(
                msg, field=tag_number(head.tag), value=f"{head.length} bytes", bound="within 64 KiB"
            )
        at = head.start + head.length
    return at


def _inflate(deflated: bytes) -> bytes:
    """Inflate (RFC 1951); stop at MAX_INFLATED_BYTES."""
    inflating = zlib.decompressobj(-zlib.MAX_WBITS)
    try:
        data = inflating.decompress(deflated, MAX_INFLATED_BYTES)
    except zlib.error as error:
        msg = "the deflated data set is damaged"
        raise PlanFormatError(msg, field="body", value="not deflated", bound="RFC 1951") from error
    if inflating.unconsumed_tail:
        bound = f"at most {MAX_INFLATED_BYTES} bytes when inflated"
        raise PlanBoundError(f"the deflated data set must be {bound}", field="body", value="more bytes", bound=bound)
    if not inflating.eof:
        msg = "the deflated data set is cut off"
        raise PlanTruncatedError(msg, field="body", value=f"{len(deflated)} bytes", bound="deflated to its end")
    return data


def _not_dicom(content: bytes) -> PlanFormatError:
    seems = next(
        (kind for begin, kind in OTHER_FORMATS.items() if content.lstrip(b" \r\n\t")[:4].startswith(begin)), ""
    )
    value = seems or ("no bytes" if not content else f"{len(content)} bytes without it")
    bound = "a DICOM file: 128 bytes, then DICM (PS3.10)"
    return PlanFormatError(f"the body must be {bound}; it is {value}", field="body", value=value, bound=bound)
