"""The transition journal's file format: a header, then slots of one transition each, every slot with its own checksum.

What is read back was written by a process that died at any instant: a slot is believed only when its checksum, its
number and its place agree. Text is cut to its room, and says so.
"""

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

from engine.live import GateTransition
from engine.permits import GateState, HoldReason

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
_ABSENT = -(2**63)
_IS_FORESEEN, _IS_TOLD, _IS_VOID = 1, 2, 3


class NotAJournalError(Exception):
    """The file's header cannot be believed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JournalHeader:
    """Whose transitions these are, and one moment on both clocks."""

    session_id: str
    boot_id: str
    anchor_utc_us: int
    anchor_ns: int
    slots: int

    def pack(self) -> bytes:
        """Write it as the file begins."""
        body = _HEADER.pack(
            *(MAGIC, SLOT_BYTES, self.slots, self.session_id.encode(), self.boot_id.encode()),
            *(self.anchor_utc_us, self.anchor_ns),
        )
        return _CHECKSUM.pack(zlib.crc32(body)) + body


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One transition that was kept; one that is only foreseen may or may not have reached the line."""

    transition: GateTransition
    is_told: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Kept:
    """What a journal holds: the transitions in order, and the slots that cannot be believed."""

    header: JournalHeader
    entries: tuple[Entry, ...]
    damaged_slots: tuple[int, ...]
    missing_numbers: tuple[int, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Slot:
    number: int
    settles: int
    kind: int
    transition: GateTransition


def pack_slot(number: int, transition: GateTransition, *, settles: int, is_told: bool) -> bytes:
    """Write one transition; ``settles`` is the number under which it was foreseen, 0 where it was not."""
    return _pack(number, transition, settles, _IS_TOLD if is_told else _IS_FORESEEN)


def pack_void(number: int, transition: GateTransition, *, settles: int) -> bytes:
    """Write that what was foreseen did not become a transition."""
    return _pack(number, transition, settles, _IS_VOID)


def place_of(number: int, slots: int) -> int:
    """Where a number's slot begins."""
    return HEADER_BYTES + (number - 1) % slots * SLOT_BYTES


def size_of(slots: int) -> int:
    """How large a journal's file is."""
    return HEADER_BYTES + slots * SLOT_BYTES


def read_kept(content: bytes) -> Kept:
    """Read a whole file; raise NotAJournalError when its header cannot be believed."""
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
    settled = {slot.settles for slot in found.values()}
    return Kept(
        header=header,
        entries=tuple(_entries(found, settled)),
        damaged_slots=tuple(damaged),
        missing_numbers=tuple(_missing(found, header.slots)),
    )


def _entries(found: dict[int, _Slot], settled: set[int]) -> Iterator[Entry]:
    for number in sorted(found):
        slot = found[number]
        if slot.kind == _IS_TOLD or (slot.kind == _IS_FORESEEN and number not in settled):
            yield Entry(transition=slot.transition, is_told=slot.kind == _IS_TOLD)


def _missing(found: dict[int, _Slot], slots: int) -> Iterator[int]:
    """Which numbers should be here and are not: the ring keeps the newest, whole laps of them."""
    newest = max(found, default=0)
    return (number for number in range(max(1, newest - slots + 1), newest) if number not in found)


def _pack(number: int, transition: GateTransition, settles: int, kind: int) -> bytes:
    reason = b"" if transition.reason is None else transition.reason.value.encode()
    from_state, to_state = transition.from_state.value.encode(), transition.to_state.value.encode()
    operator = _cut(transition.operator or "", _OPERATOR_BYTES)
    fixed = from_state + to_state + reason + operator
    detail = _cut(transition.detail, _TEXT_BYTES - len(fixed))
    body = _SLOT.pack(
        *(number, settles, kind),
        *(transition.at_ns, transition.decided_ns, transition.asserted_ns),
        *map(_or_absent, (transition.frame_index, transition.captured_us, transition.received_ns)),
        _or_absent(transition.captured_ns),
        *(len(from_state), len(to_state), len(reason), len(operator), len(detail)),
    )
    body = (body + fixed + detail).ljust(SLOT_BYTES - _CHECKSUM.size, b"\0")
    return _CHECKSUM.pack(zlib.crc32(body)) + body


def read_header(content: bytes) -> JournalHeader:
    """Read how a file begins; raise NotAJournalError when that cannot be believed."""
    raw = content[: _CHECKSUM.size + _HEADER.size]
    if len(raw) < _CHECKSUM.size + _HEADER.size:
        msg = "the file is too short for a header"
        raise NotAJournalError(msg)
    (checksum,), body = _CHECKSUM.unpack_from(raw), raw[_CHECKSUM.size :]
    magic, slot_bytes, slots, session, boot, anchor_utc_us, anchor_ns = _HEADER.unpack(body)
    if zlib.crc32(body) != checksum or magic != MAGIC or slot_bytes != SLOT_BYTES:
        msg = "the header's checksum or format is another"
        raise NotAJournalError(msg)
    try:
        session_id, boot_id = (name.rstrip(b"\0").decode() for name in (session, boot))
    except UnicodeDecodeError as error:
        msg = "the header's names are no text"
        raise NotAJournalError(msg) from error
    if not 0 < slots <= MAX_SLOTS or len(content) != size_of(slots):
        msg = f"{slots} slots do not fit a file of {len(content)} bytes"
        raise NotAJournalError(msg)
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
    number, settles, kind, *rest = _SLOT.unpack_from(body)
    at_ns, decided_ns, asserted_ns, frame_index, captured_us, received_ns, captured_ns, *lengths = rest
    text, begin = [], _SLOT.size
    for length in lengths:
        text.append(body[begin : begin + length].decode(errors="replace"))
        begin += length
    from_state, to_state, reason, operator, detail = text
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
        )
    except ValueError:  # the words of another version
        return None
    return _Slot(number=number, settles=settles, kind=kind, transition=transition)


def _or_absent(value: int | None) -> int:
    return _ABSENT if value is None else value


def _or_none(value: int) -> int | None:
    return None if value == _ABSENT else value


def _cut(text: str, room: int) -> bytes:
    raw = text.encode()
    if len(raw) <= room:
        return raw
    kept = raw[: room - len(CUT)].decode(errors="ignore")
    return (kept + CUT).encode()
