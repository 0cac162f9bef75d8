"""The DICOM file around a data set: preamble, meta information, transfer syntax, inflating (PS3.10, 7.1; PS3.5, A)."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

from service.plans.errors import PlanBoundError, PlanFormatError, PlanTruncatedError
from service.plans.tags import META, Tag, named, told
from service.plans.walk import EXPLICIT_BIG, EXPLICIT_LITTLE, IMPLICIT_LITTLE, Form, Item, Walk

PREAMBLE_BYTES = 128
PREFIX = b"DICM"
META_GROUP = 0x0002
MAX_META_BYTES = 65_536
MAX_INFLATED_BYTES = 33_554_432
"""32 MiB: what a deflated data set may become. Zeros deflate a thousandfold."""

DEFLATED = "1.2.840.10008.1.2.1.99"
FORMS: Mapping[str, Form] = {
    "1.2.840.10008.1.2": IMPLICIT_LITTLE,
    "1.2.840.10008.1.2.1": EXPLICIT_LITTLE,
    DEFLATED: EXPLICIT_LITTLE,
    "1.2.840.10008.1.2.2": EXPLICIT_BIG,
}
FOREIGN = {
    b"\xff\xd8\xff": "a JPEG picture",
    b"\x89PNG": "a PNG picture",
    b"PK\x03\x04": "a ZIP archive",
    b"\x1f\x8b": "a gzip archive",
    b"%PDF": "a PDF document",
    b"{": "JSON",
    b"[": "JSON",
    b"<": "XML",
}
"""What is sent by mistake, by how it begins: said, so that a person sees the mistake."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Part10:
    """A DICOM file, opened: the bytes of its data set, how they are written, and what its meta information says."""

    data: bytes
    start: int
    form: Form
    meta: Item


def open_file(content: bytes) -> Part10:
    """Open a DICOM file.

    Raises
    ------
    PlanFormatError
        It is none, or its transfer syntax is not one that plans are written in.
    PlanTruncatedError, PlanBoundError
        It is cut off, or becomes too large.
    """
    if content[PREAMBLE_BYTES : PREAMBLE_BYTES + len(PREFIX)] != PREFIX:
        raise _foreign(content)
    start = _meta_end(content)
    walk = Walk(data=content[:start])
    meta = walk.dataset(PREAMBLE_BYTES + len(PREFIX), EXPLICIT_LITTLE, META)
    syntax = plain_uid(meta, Tag.TRANSFER_SYNTAX)
    form = FORMS.get(syntax)
    if form is None:
        msg = f"the transfer syntax {syntax} is not one that plans are written in"
        raise PlanFormatError(msg, field=named(Tag.TRANSFER_SYNTAX), value=syntax, bound=f"one of {', '.join(FORMS)}")
    if syntax == DEFLATED:
        return Part10(data=_inflate(content[start:]), start=0, form=form, meta=meta)
    return Part10(data=content, start=start, form=form, meta=meta)


def plain_uid(item: Item, tag: Tag) -> str:
    """Return a UID of the meta information, unchecked but for its characters."""
    raw = item.get(tag, b"")
    text = bytes(raw).rstrip(b"\0 ").decode("ascii", "replace") if isinstance(raw, bytes) else ""
    if not text or not set(text) <= set("0123456789.") or len(text) > 64:
        msg = f"the file's meta information has no {named(tag)}, or none that can be one"
        raise PlanFormatError(msg, field=named(tag), value=f"{len(text)} characters", bound="a UID")
    return text


def _meta_end(content: bytes) -> int:
    """Find where the meta information ends: it goes as far as its group (PS3.10, 7.1)."""
    walk = Walk(data=content)
    at, limit = PREAMBLE_BYTES + len(PREFIX), min(len(content), PREAMBLE_BYTES + MAX_META_BYTES)
    while at + 4 <= len(content) and EXPLICIT_LITTLE.tag.unpack_from(content, at)[0] == META_GROUP:
        head = walk.head(at, len(content), EXPLICIT_LITTLE)
        if head.length > limit - head.start:
            msg = "the file is cut off, or its meta information is longer than any"
            raise PlanTruncatedError(msg, field=told(head.tag), value=f"{head.length} bytes", bound="within 64 KiB")
        at = head.start + head.length
    return at


def _inflate(deflated: bytes) -> bytes:
    """Inflate (RFC 1951) as far as the bound and no further."""
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


def _foreign(content: bytes) -> PlanFormatError:
    seems = next((kind for begin, kind in FOREIGN.items() if content.lstrip(b" \r\n\t")[:4].startswith(begin)), "")
    value = seems or ("no bytes" if not content else f"{len(content)} bytes without it")
    bound = "a DICOM file: 128 bytes, then DICM (PS3.10)"
    return PlanFormatError(f"the body must be {bound}; it is {value}", field="body", value=value, bound=bound)
