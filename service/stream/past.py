"""What a client missed, as messages: rows of the record, written in a worker thread and not on the event loop."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import NamedTuple

import pyarrow as pa

from engine.clock import NS_PER_MS, NS_PER_S
from engine.permits import HoldReason
from service.hold_texts import hold_text
from service.live_messages import RecordedSample
from service.live_view import known
from service.samples.layout import SampleHead
from service.samples.tail import NothingRecordedError, Row, SampleTails
from service.stream.spoken import Shape, written

DIGITS = 4
REASONS = {reason.value: reason for reason in HoldReason}
"""Looked up and not called: an older record may have one that is none any more."""
LENGTHS = ("signal_mm", "whole_mm", "thorax_mm", "abdomen_mm", "volume_l")


class Recorded(NamedTuple):
    """A frame of the record, ready to go out; without a payload where the asked rate leaves it out."""

    frame: int
    payload: str | bytes | None


@dataclass(frozen=True, slots=True, kw_only=True)
class PastPage:
    """Some frames of the record; ``is_last`` when there are no more yet."""

    frames: list[Recorded]
    is_last: bool


class Past:
    """One client's way through the record; one call at a time, from any thread."""

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
        """Return what follows; None where there is no record of the session."""
        try:
            if self._oldest_ns is None:
                self._oldest_ns = self._tails.newest_ns(self._session_id) - self._longest_ns
            found = self._tails.page(self._session_id, self._last, oldest_ns=self._oldest_ns, most=most)
        except (NothingRecordedError, pa.ArrowException, OSError):
            return None
        frames = list(self._written(found.rows, found.head))
        if frames:
            self._last = frames[-1].frame
        return PastPage(frames=frames, is_last=len(found.rows) < most)

    def _written(self, rows: list[Row], head: SampleHead) -> Iterator[Recorded]:
        sent_at = datetime.now(UTC)
        for row in rows:
            index = int(row["frame_index"])
            if not self._is_wanted(row):
                yield Recorded(index, None)
                continue
            message = recorded_sample(row, head, sent_at)
            yield Recorded(index, written(message, self._shape, f"{self._session_id}:{index}"))

    def _is_wanted(self, row: Row) -> bool:
        """Keep to the asked rate; a change of the gate is always sent."""
        gate = (row["gate"], row["hold_reason"], row["line_on"])
        is_change, self._gate = gate != self._gate, gate
        is_due = row["received_ns"] >= self._due_ns
        if is_due:
            self._due_ns = row["received_ns"] + self._period_ns
        return is_due or is_change


def recorded_sample(row: Row, head: SampleHead, sent_at: datetime) -> RecordedSample:
    """Make a message of a row."""
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
        **{name: None if known(row[name]) is None else round(row[name], DIGITS) for name in LENGTHS},
    )


def _at(head: SampleHead, monotonic_ns: int | None) -> datetime | None:
    """Turn the host's monotonic time into the time of day, by the moment that the file's head has on both clocks."""
    if monotonic_ns is None or not head.utc:
        return None
    moment = datetime.fromisoformat(head.utc)
    return (moment + timedelta(microseconds=(monotonic_ns - head.monotonic_ns) / 1e3)).astimezone(UTC)
