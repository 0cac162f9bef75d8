"""A client that comes back: what it missed from the record, up to where the live stream takes over; no frame twice.

While the record is read, live frames are kept for the client; the recorder is waited for until it has passed the first
of them, and not for ever. Whatever is not sent again is said to be missing.
"""

import anyio
import anyio.to_thread

from service.live_messages import Gap, Resumed
from service.samples.tail import SampleTails
from service.stream.asking import EventsQuery
from service.stream.feeding import Feed, Resume
from service.stream.past import Past, PastPage
from service.stream.spoken import Frame

PAGE = 200
PER_S = 2000.0
"""Samples a second from the record: a client that was away does not keep the others waiting."""
AT_ONCE = 4
BUSY_S = 1.0
SEAM_S = 2.0
LOOK_S = 0.05


class Resumption:
    """Tells clients what they missed, a few at a time."""

    def __init__(self, tails: SampleTails, *, longest_s: float) -> None:
        self._tails = tails
        self._longest_s = longest_s
        self._places = anyio.CapacityLimiter(AT_ONCE)
        self._threads = anyio.CapacityLimiter(AT_ONCE)  # of their own: no request waits for one of them

    def asked(self, query: EventsQuery) -> Resume | None:
        """Return what is to be done before the live stream; None where nothing was asked for."""
        session_id, after = query.session_id, query.after_frame
        if session_id is None or after is None:
            return None

        async def resume(feed: Feed) -> None:
            await self._resume(feed, session_id, after, query.rate_hz)

        return resume

    async def _resume(self, feed: Feed, session_id: str, after: int, rate_hz: float | None) -> None:
        """Send what was recorded after a frame, then let the live stream go on."""
        with anyio.move_on_after(BUSY_S) as waiting:
            await self._places.acquire()
        if waiting.cancelled_caught:
            await _Telling(feed, session_id, after).leave_out("busy")
            return
        try:
            past = Past(
                self._tails,
                feed.place.shape,
                session_id=session_id,
                after=after,
                longest_s=self._longest_s,
                rate_hz=rate_hz,
            )
            await _Telling(feed, session_id, after).tell(past, self._threads)
        finally:
            self._places.release()


class _Telling:
    """One client's way from the record to the live stream."""

    def __init__(self, feed: Feed, session_id: str, after: int) -> None:
        self._feed = feed
        self._hub = feed.hub
        self._place = feed.place
        self._session_id = session_id
        self._after = self._last = after
        self._sent = 0

    async def tell(self, past: Past, threads: anyio.CapacityLimiter) -> None:
        """Tell the record up to the first live frame that is kept."""
        caught_up_s: float | None = None
        while True:
            page = await anyio.to_thread.run_sync(past.page, PAGE, limiter=threads)
            if page is None:
                await self.leave_out("not_recorded")
                return
            await self._send(page)
            if not page.is_last:
                continue
            if self._meets():
                await self._go_on()
                return
            caught_up_s = caught_up_s or self._hub.now_s()
            if self._hub.now_s() > caught_up_s + SEAM_S:
                await self.leave_out("recorder_behind")
                return
            await anyio.sleep(LOOK_S)

    async def leave_out(self, reason: str) -> None:
        """Say what is not sent, and let the live stream go on."""
        first = self._first_live()
        to_frame = None if first is None else first.index - 1
        if to_frame is None or to_frame > self._last:
            await self._gap(self._last + 1, to_frame, reason)
        await self._go_on()

    async def _send(self, page: PastPage) -> None:
        if page.frames and self._sent == 0 and self._last == self._after and page.frames[0].frame > self._after + 1:
            await self._gap(self._after + 1, page.frames[0].frame - 1, "too_long_ago")
        for recorded in page.frames:
            self._last = recorded.frame
            if recorded.payload is not None:
                self._sent += 1
                await self._feed.put(recorded.payload)
        await anyio.sleep(len(page.frames) / PER_S)

    def _meets(self) -> bool:
        """Whether what was sent reaches to the first live frame that is kept, or the session is over."""
        first = self._first_live()
        return first is None or self._last >= first.index - 1

    def _first_live(self) -> Frame | None:
        first = self._place.first_held
        return first if first is not None and first.session_id == self._session_id else None

    async def _gap(self, from_frame: int, to_frame: int | None, reason: str) -> None:
        gap = {"session_id": self._session_id, "from_frame": from_frame, "to_frame": to_frame, "reason": reason}
        await self._feed.tell(Gap.model_validate({"sent_at": self._hub.clock.utc(), **gap}))

    async def _go_on(self) -> None:
        """Say that what follows is live, and send the frames that were kept and are not told yet."""
        told = Resumed(
            sent_at=self._hub.clock.utc(), session_id=self._session_id, frames=self._sent, last_frame=self._last
        )
        await self._feed.tell(told)
        for frame in self._place.release():
            if not self._is_told(frame):
                await self._feed.give(frame)

    def _is_told(self, frame: Frame) -> bool:
        """Whether the record had it: not what changed between two frames."""
        if frame.session_id != self._session_id or frame.index > self._last:
            return False
        return not (frame.is_repeat and frame.is_change)
