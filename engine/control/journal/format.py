"""The transition journal's file format: a header, then slots of one transition each, every slot with its own checksum.

The file may have been written by a process that died at any instant: a slot is valid only where its checksum, its
number and its position agree. Text that is too long is cut, and ends with a mark. Who armed follows the detail, up to
the padding: slots of earlier versions end there.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

from engine.control.outputs import GateTransition
from engine.core.gate_state import GateState, HoldReason

MAGIC = b"TGJRNL01"
HEADER_BYTES = 4096
SLOT_BYTES = 1024
SESSION_BYTES = 64
BOOT_BYTES = 48
MAX_SLOTS = 65_536
CUT = "... (cut)"

_CHECKSUM = struct.Struct("<I")
_HEADER = struct.Struct(f"<8sII{SESSION_BYTES}s{BOOT_BYTES}sqq")
_SLOT = struct.Struct("<QQB7qBBBHH")
_TEXT_BYTES = SLOT_BYTES - _CHECKSUM.size - _SLOT.size
_OPERATOR_BYTES = 400
_ARMED_BY_BYTES = 200
_ABSENT = -(2**63)
_PREPARED, _COMMITTED, _ABORTED = 1, 2, 3


class JournalFormatError(Exception):
    """The file's header is not valid."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JournalHeader:
    """The session, and one moment on both clocks: host monotonic [ns] and UTC [us]."""

    session_id: str
    boot_id: str
    anchor_utc_us: int
    anchor_ns: int
    slots: int

    def pack(self) -> bytes:
        """Return the header as bytes, with its checksum."""
        body = _HEADER.pack(
            *(MAGIC, SLOT_BYTES, self.slots, self.session_id.encode(), self.boot_id.encode()),
            *(self.anchor_utc_us, self.anchor_ns),
        )
        return _CHECKSUM.pack(zlib.crc32(body)) + body


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One transition of the journal; where it is only prepared, the permit may or may not have reached the line."""

    transition: GateTransition
    is_committed: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class RecoveredJournal:
    """The content of a journal: its transitions in order, and its damaged slots."""

    header: JournalHeader
    entries: tuple[Entry, ...]
    damaged_slots: tuple[int, ...]
    missing_numbers: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Slot:
    number: int
    prepared: int
    kind: int
    transition: GateTransition


def pack_slot(number: int, transition: GateTransition, *, prepared: int, is_committed: bool) -> bytes:
    """Return a slot with one transition; ``prepared`` is the number of its prepared entry, 0 where it has none."""
    return _pack(number, transition, prepared, _COMMITTED if is_committed else _PREPARED)


def pack_aborted(number: int, transition: GateTransition, *, prepared: int) -> bytes:
    """Return a slot that aborts a prepared entry."""
    return _pack(number, transition, prepared, _ABORTED)


def slot_offset(number: int, slots: int) -> int:
    """Return where a number's slot begins [bytes]."""
    return HEADER_BYTES + (number - 1) % slots * SLOT_BYTES


def file_size(slots: int) -> int:
    """Return the size of a journal's file [bytes]."""
    return HEADER_BYTES + slots * SLOT_BYTES


def read_journal(content: bytes) -> RecoveredJournal:
    """Read a whole file; raise JournalFormatError where its header is not valid."""
    header = read_header(content)
    found: dict[int, _Slot] = {}
    damaged: list[int] = []
    for index in range(header.slots):
        raw = content[HEADER_BYTES + index * SLOT_BYTES :][:SLOT_BYTES]
        if not any(raw):
            continue
        slot = _read_slot(raw)
        if slot is None or (slot.number - 1) % header.slots != index:
            damaged.append(index)
        else:
            found[slot.number] = slot
    resolved = {slot.prepared for slot in found.values()}
    return RecoveredJournal(
        header=header,
        entries=tuple(_entries(found, resolved)),
        damaged_slots=tuple(damaged),
        missing_numbers=tuple(_missing(found, header.slots)),
    )


def _entries(found: dict[int, _Slot], resolved: set[int]) -> Iterator[Entry]:
    for number in sorted(found):
        slot = found[number]
        if slot.kind == _COMMITTED or (slot.kind == _PREPARED and number not in resolved):
            yield Entry(transition=slot.transition, is_committed=slot.kind == _COMMITTED)


def _missing(found: dict[int, _Slot], slots: int) -> Iterator[int]:
    """Yield the numbers that are missing among those that the ring still holds."""
    newest = max(found, default=0)
    return (number for number in range(max(1, newest - slots + 1), newest) if number not in found)


def _pack(number: int, transition: GateTransition, prepared: int, kind: int) -> bytes:
    reason = b"" if transition.reason is None else transition.reason.value.encode()
    from_state, to_state = transition.from_state.value.encode(), transition.to_state.value.encode()
    operator = _cut(transition.operator or "", _OPERATOR_BYTES)
    fixed = from_state + to_state + reason + operator
    armed_by = _cut(transition.armed_by or "", _ARMED_BY_BYTES)
    detail = _cut(transition.detail, _TEXT_BYTES - len(fixed) - len(armed_by))
    body = _SLOT.pack(
        *(number, prepared, kind),
        *(transition.at_ns, transition.decided_ns, transition.asserted_ns),
        *map(_or_absent, (transition.frame_index, transition.captured_us, transition.received_ns)),
        _or_absent(transition.captured_ns),
        *(len(from_state), len(to_state), len(reason), len(operator), len(detail)),
    )
    body = (body + fixed + detail + armed_by).ljust(SLOT_BYTES - _CHECKSUM.size, b"\0")
    return _CHECKSUM.pack(zlib.crc32(body)) + body


def read_header(content: bytes) -> JournalHeader:
    """Read a file's header; raise JournalFormatError where it is not valid."""
    raw = content[: _CHECKSUM.size + _HEADER.size]
    if len(raw) < _CHECKSUM.size + _HEADER.size:
        msg = "the file is too short for a header"
        raise JournalFormatError(msg)
    (checksum,), body = _CHECKSUM.unpack_from(raw), raw[_CHECKSUM.size :]
    magic, slot_bytes, slots, session, boot, anchor_utc_us, anchor_ns = _HEADER.unpack(body)
    if zlib.crc32(body) != checksum or magic != MAGIC or slot_bytes != SLOT_BYTES:
        msg = "the header's checksum or format is another"
        raise JournalFormatError(msg)
    try:
        session_id, boot_id = (name.rstrip(b"\0").decode() for name in (session, boot))
    except UnicodeDecodeError as error:
        msg = "the header's names are no text"
        raise JournalFormatError(msg) from error
    if not 0 < slots <= MAX_SLOTS or len(content) != file_size(slots):
        msg = f"{slots} slots do not fit a file of {len(content)} bytes"
        raise JournalFormatError(msg)
    return JournalHeader(
        session_id=session_id,
        boot_id=boot_id,
        anchor_utc_us=anchor_utc_us,
        anchor_ns=anchor_ns,
        slots=slots,
    )


def _read_slot(raw: bytes) -> _Slot | None:
    (checksum,), body = _CHECKSUM.unpack_from(raw), raw[_CHECKSUM.size :]
    if zlib.crc32(body) != checksum:
        return None
    number, prepared, kind, *rest = _SLOT.unpack_from(body)
    at_ns, decided_ns, asserted_ns, frame_index, captured_us, received_ns, captured_ns, *lengths = rest
    text, begin = [], _SLOT.size
    for length in lengths:
        text.append(body[begin : begin + length].decode(errors="replace"))
        begin += length
    from_state, to_state, reason, operator, detail = text
    armed_by = body[begin:].rstrip(b"\0").decode(errors="replace")
    try:
        transition = GateTransition(
            at_ns=at_ns,
            frame_index=_or_none(frame_index),
            from_state=GateState(from_state),
            to_state=GateState(to_state),
            reason=HoldReason(reason) if reason else None,
            operator=operator or None,
            detail=detail,
            captured_us=_or_none(captured_us),
            received_ns=_or_none(received_ns),
            decided_ns=decided_ns,
            asserted_ns=asserted_ns,
            captured_ns=_or_none(captured_ns),
            number=number,
            armed_by=armed_by or None,
        )
    except ValueError:  # a state or a reason of another version
        return None
    return _Slot(number=number, prepared=prepared, kind=kind, transition=transition)


def _or_absent(value: int | None) -> int:
    return _ABSENT if value is None else value


def _or_none(value: int) -> int | None:
    return None if value == _ABSENT else value


def _cut(text: str, limit_bytes: int) -> bytes:
    raw = text.encode()
    if len(raw) <= limit_bytes:
        return raw
    kept = raw[: limit_bytes - len(CUT)].decode(errors="ignore")
    return (kept + CUT).encode()
