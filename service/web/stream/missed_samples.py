"""Recorded samples that a client missed, encoded in a worker thread instead of the event loop."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

import pyarrow as pa

from engine.core.clock import NS_PER_MS, NS_PER_S
from engine.core.gate_state import HoldReason
from service.core.finite import rounded_or_none
from service.core.hold_texts import hold_text
from service.core.schemas.live_messages import RecordedSample
from service.storage.samples.layout import SampleHead
from service.storage.samples.tail import NothingRecordedError, Row, SampleTails
from service.web.stream.encoding import Shape, encode

DIGITS = 4
REASONS = {reason.value: reason for reason in HoldReason}
"""Reasons by code; an older record may have a code that no longer exists."""
LENGTHS = ("signal_mm", "whole_mm", "thorax_mm", "abdomen_mm", "volume_l")


class Recorded(NamedTuple):
    """A recorded frame, encoded; without a payload if the requested rate drops it."""

    frame: int
    payload: str | bytes | None


@dataclass(frozen=True, slots=True, kw_only=True)
class PastPage:
    """A page of recorded frames; ``is_last`` if there are no more yet."""

    frames: list[Recorded]
    is_last: bool


class MissedSamples:
    """Reads the record for one client; one call at a time, from any thread."""

    def __init__(
        self,
        tails: SampleTails,
        shape: Shape,
        *,
        session_id: str,
        after: int,
        longest_s: float,
        rate_hz: float | None = None,
    ) -> None:
        self._tails = tails
        self._shape = shape
        self._session_id = session_id
        self._last = after
        self._longest_ns = round(longest_s * NS_PER_S)
        self._oldest_ns: int | None = None
        self._period_ns = 0 if rate_hz is None else round(NS_PER_S / rate_hz)
        self._due_ns = 0
        self._gate: tuple[object, ...] | None = None

    def page(self, most: int) -> PastPage | None:
        """Return the next page; None if there is no record of the session."""
        try:
            if self._oldest_ns is None:
                self._oldest_ns = self._tails.newest_ns(self._session_id) - self._longest_ns
            found = self._tails.page(self._session_id, self._last, oldest_ns=self._oldest_ns, most=most)
        except (NothingRecordedError, pa.ArrowException, OSError):
            return None
        frames = list(self._encode_rows(found.rows, found.head))
        if frames:
            self._last = frames[-1].frame
        return PastPage(frames=frames, is_last=len(found.rows) < most)

    def _encode_rows(self, rows: list[Row], head: SampleHead) -> Iterator[Recorded]:
        sent_at = datetime.now(UTC)
        for row in rows:
            index = int(row["frame_index"])
            if not self._is_sent(row):
                yield Recorded(index, None)
                continue
            message = recorded_sample(row, head, sent_at)
            yield Recorded(index, encode(message, self._shape, f"{self._session_id}:{index}"))

    def _is_sent(self, row: Row) -> bool:
        """Whether a row is sent at the requested rate; a change of the gate always is."""
        gate = (row["gate"], row["hold_reason"], row["line_on"])
        is_change, self._gate = gate != self._gate, gate
        is_due = row["received_ns"] >= self._due_ns
        if is_due:
            self._due_ns = row["received_ns"] + self._period_ns
        return is_due or is_change


def recorded_sample(row: Row, head: SampleHead, sent_at: datetime) -> RecordedSample:
    """Convert a row of the record to a message."""
    captured_ns = row["captured_ns"]
    return RecordedSample(
        captured_at=_at(head, captured_ns),
        received_at=_at(head, row["received_ns"]),
        sent_at=sent_at,
        session_id=head.session_id,
        frame_index=row["frame_index"],
        timestamp_us=row["timestamp_us"],
        state=row["state"],
        gate=row["gate"],
        hold_reason=row["hold_reason"],
        hold_text=hold_text(REASONS.get(row["hold_reason"])),
        line_on=row["line_on"],
        latency_ms=None if captured_ns is None else round((row["asserted_ns"] - captured_ns) / NS_PER_MS, DIGITS),
        **{name: rounded_or_none(row[name], DIGITS) for name in LENGTHS},
    )


def _at(head: SampleHead, monotonic_ns: int | None) -> datetime | None:
    """Convert host monotonic time to UTC, with the pair of times in the file's header."""
    if monotonic_ns is None or not head.utc:
        return None
    moment = datetime.fromisoformat(head.utc)
    return (moment + timedelta(microseconds=(monotonic_ns - head.monotonic_ns) / 1e3)).astimezone(UTC)
