"""Resends missed samples to a client that reconnects, from the record up to the live stream; no frame twice.

While the record is read, live frames are buffered for the client, until the recorder has written the first of them or a
time limit is over. Frames that are not resent are reported as a gap.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import NamedTuple

import anyio
import anyio.to_thread
import pyarrow as pa

from engine.core.clock import NS_PER_MS, NS_PER_S
from engine.core.gate_state import HoldReason
from service.core.alarm_table import hold_text
from service.core.schemas.base import rounded_or_none
from service.core.schemas.live_messages import Gap, RecordedSample, Resumed
from service.storage.samples.layout import SampleHead
from service.storage.samples.tail import NothingRecordedError, Row, SampleTails
from service.web.stream.encoding import Frame, Shape, StreamQuery, encode
from service.web.stream.feed import Feed, Resume

DIGITS = 4
REASONS = {reason.value: reason for reason in HoldReason}
"""Reasons by code; an older record may have a code that no longer exists."""
LENGTHS = ("signal_mm", "whole_mm", "thorax_mm", "abdomen_mm", "volume_l")
PAGE = 200
PER_S = 2000.0
"""Rate limit of recorded samples [1/s], so that reconnecting clients do not delay the others."""
MAX_CONCURRENT = 4
BUSY_S = 1.0
RECORDER_WAIT_S = 2.0
RETRY_S = 0.05


# Recorded samples that a client missed, encoded in a worker thread instead of the event loop.
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
        captured_at=head.at(captured_ns),
        received_at=head.at(row["received_ns"]),
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


class Resumption:
    """Resends missed samples, to a few clients at a time."""

    def __init__(self, tails: SampleTails, *, longest_s: float) -> None:
        self._tails = tails
        self._longest_s = longest_s
        self._limiter = anyio.CapacityLimiter(MAX_CONCURRENT)
        self._threads = anyio.CapacityLimiter(MAX_CONCURRENT)  # separate threads: no request waits for them

    def for_query(self, query: StreamQuery) -> Resume | None:
        """Return the function that resends missed samples; None if the query does not request them."""
        session_id, after = query.session_id, query.after_frame
        if session_id is None or after is None:
            return None

        async def resume(feed: Feed) -> None:
            await self._resume(feed, session_id, after, query.rate_hz)

        return resume

    async def _resume(self, feed: Feed, session_id: str, after: int, rate_hz: float | None) -> None:
        """Send the samples recorded after a frame, then continue with the live stream."""
        with anyio.move_on_after(BUSY_S) as waiting:
            await self._limiter.acquire()
        if waiting.cancelled_caught:
            await _RecordSender(feed, session_id, after).report_gap("busy")
            return
        try:
            past = MissedSamples(
                self._tails,
                feed.slot.shape,
                session_id=session_id,
                after=after,
                longest_s=self._longest_s,
                rate_hz=rate_hz,
            )
            await _RecordSender(feed, session_id, after).run(past, self._threads)
        finally:
            self._limiter.release()


class _RecordSender:
    """Resends the record to one client until it meets the live stream."""

    def __init__(self, feed: Feed, session_id: str, after: int) -> None:
        self._feed = feed
        self._hub = feed.hub
        self._slot = feed.slot
        self._session_id = session_id
        self._after = self._last = after
        self._sent = 0

    async def run(self, past: MissedSamples, threads: anyio.CapacityLimiter) -> None:
        """Send the record up to the first buffered live frame."""
        caught_up_s: float | None = None
        while True:
            page = await anyio.to_thread.run_sync(past.page, PAGE, limiter=threads)
            if page is None:
                await self.report_gap("not_recorded")
                return
            await self._send(page)
            if not page.is_last:
                continue
            if self._reaches_live():
                await self._go_live()
                return
            caught_up_s = caught_up_s or self._hub.now_s()
            if self._hub.now_s() > caught_up_s + RECORDER_WAIT_S:
                await self.report_gap("recorder_behind")
                return
            await anyio.sleep(RETRY_S)

    async def report_gap(self, reason: str) -> None:
        """Report the gap and continue with the live stream."""
        first = self._first_live()
        to_frame = None if first is None else first.index - 1
        if to_frame is None or to_frame > self._last:
            await self._gap(self._last + 1, to_frame, reason)
        await self._go_live()

    async def _send(self, page: PastPage) -> None:
        if page.frames and self._sent == 0 and self._last == self._after and page.frames[0].frame > self._after + 1:
            await self._gap(self._after + 1, page.frames[0].frame - 1, "too_long_ago")
        for recorded in page.frames:
            self._last = recorded.frame
            await self._feed.send_alarms()
            if recorded.payload is not None:
                self._sent += 1
                await self._feed.send_payload(recorded.payload)
        await anyio.sleep(len(page.frames) / PER_S)

    def _reaches_live(self) -> bool:
        """Whether the sent samples reach the first buffered live frame, or the session has ended."""
        first = self._first_live()
        return first is None or self._last >= first.index - 1

    def _first_live(self) -> Frame | None:
        first = self._slot.first_buffered
        return first if first is not None and first.session_id == self._session_id else None

    async def _gap(self, from_frame: int, to_frame: int | None, reason: str) -> None:
        gap = {"session_id": self._session_id, "from_frame": from_frame, "to_frame": to_frame, "reason": reason}
        await self._feed.send(Gap.model_validate({"sent_at": self._hub.clock.utc(), **gap}))

    async def _go_live(self) -> None:
        """Announce the live stream, and send the buffered frames that were not resent."""
        resumed = Resumed(
            sent_at=self._hub.clock.utc(), session_id=self._session_id, frames=self._sent, last_frame=self._last
        )
        await self._feed.send(resumed)
        for frame in self._slot.stop_buffering():
            if not self._is_resent(frame):
                await self._feed.send_shared(frame)

    def _is_resent(self, frame: Frame) -> bool:
        """Whether the frame was resent; changes of the gate between two frames are not in the record."""
        if frame.session_id != self._session_id or frame.index > self._last:
            return False
        return not (frame.is_repeat and frame.is_change)
