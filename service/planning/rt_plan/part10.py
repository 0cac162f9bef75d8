"""The DICOM file around a data set: preamble, meta information, transfer syntax, inflating (PS3.10, 7.1; PS3.5, A)."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass

from service.planning.rt_plan.element_reader import (
    EXPLICIT_BIG,
    EXPLICIT_LITTLE,
    IMPLICIT_LITTLE,
    ElementReader,
    Form,
    Item,
)
from service.planning.rt_plan.errors import PlanBoundError, PlanFormatError, PlanTruncatedError
from service.planning.rt_plan.tags import META, Tag, named, tag_number

PREAMBLE_BYTES = 128
PREFIX = b"DICM"
META_GROUP = 0x0002
MAX_META_BYTES = 65_536
MAX_INFLATED_BYTES = 33_554_432
"""32 MiB, the largest inflated data set. Zeros deflate by a factor of 1000."""

DEFLATED = "1.2.840.10008.1.2.1.99"
FORMS: Mapping[str, Form] = {
    "1.2.840.10008.1.2": IMPLICIT_LITTLE,
    "1.2.840.10008.1.2.1": EXPLICIT_LITTLE,
    DEFLATED: EXPLICIT_LITTLE,
    "1.2.840.10008.1.2.2": EXPLICIT_BIG,
}
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
