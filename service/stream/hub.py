"""The hub: one task sees each new frame once, and puts it into every client's place.

It runs while somebody watches, on the event loop. It waits for no client: whoever is slow finds the newest when it is
ready for it, and whoever takes nothing for too long is let go.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import anyio

from service.live_messages import Idle, Ping, Sample
from service.ports import LiveFrame, RunnerPort
from service.stream.counts import StreamCounts, StreamReading, Why
from service.stream.place import Place
from service.stream.spoken import Frame, Plain, Press, Shape, StreamClock

logger = logging.getLogger(__name__)

POLL_S = 0.003
IDLE_S = 0.5
PING_S = 1.0
TEND_S = 0.25
CHECK_S = 1.0
"""How often it is asked whether a client may still watch; it counts as using the log-in, too."""
MayStay = Callable[[], bool]


@dataclass(slots=True, eq=False)
class Client:
    """Somebody who watches."""

    place: Place
    may_stay: MayStay
    scope: anyio.CancelScope
    checked_s: float
    why: Why = "gone"

    def end(self, why: Why) -> None:
        """Let it go."""
        self.why = why
        self.scope.cancel()


class LiveHub:
    """Everybody who watches, and the one task that looks for news."""

    def __init__(
        self,
        runner: RunnerPort,
        *,
        max_clients: int,
        stall_s: float,
        now_s: Callable[[], float] | None = None,
    ) -> None:
        self._runner = runner
        self._max_clients = max_clients
        self._stall_s = stall_s
        self._now_s = now_s or (lambda: asyncio.get_running_loop().time())
        self.clock = StreamClock(now_s=self._now_s, now_ns=runner.now_ns)
        self._press = Press(self.clock)
        self._clients: set[Client] = set()
        self._counts = StreamCounts()
        self._task: asyncio.Task[None] | None = None
        self._is_leaving = False
        self._last: LiveFrame | None = None
        self._sequence = -1
        self._idle_s = self._tended_s = 0.0
        self.newest: Frame | None = None

    @contextmanager
    def enter(
        self, shape: Shape, *, rate_hz: float | None, may_stay: MayStay, holds: bool = False
    ) -> Iterator[Client | None]:
        """Take a place for as long as the block lasts; None where all are taken. For the event loop's thread.

        With ``holds`` frames are kept until the client has been told what it missed.
        """
        if len(self._clients) >= self._max_clients or self._is_leaving:
            self._counts.closed["full"] += 1
            yield None
            return
        now_s = self._now_s()
        place = Place(shape, rate_hz=rate_hz, now_s=now_s)
        if holds:
            place.hold()
        client = Client(place=place, may_stay=may_stay, scope=anyio.CancelScope(), checked_s=now_s)
        self._look(now_s)  # what was seen last may be from when somebody last watched
        self._clients.add(client)
        if self.newest is not None:
            place.offer(self.newest, now_s)
            place.forget_skipped()  # of the time before it was there
        self._ensure_running()
        try:
            yield client
        finally:
            self._clients.discard(client)
            self._counts.skipped += place.left_out
            self._counts.closed[client.why] += 1

    def leave(self) -> None:
        """Let everybody go: the service ends. From any thread; the next look does it."""
        self._is_leaving = True

    def sent(self) -> None:
        """Count a message that went out."""
        self._counts.sent += 1

    def now_s(self) -> float:
        """Return the stream's clock."""
        return self._now_s()

    def running(self) -> Sample | None:
        """Return the newest sample of the session that runs."""
        return None if self.newest is None else self.newest.live.message

    def reading(self) -> StreamReading:
        """Tell how it stands; from any thread."""
        clients = list(self._clients)
        shapes = (one.place.shape for one in clients)
        kinds: Counter[tuple[str, str, str]] = Counter(
            (shape.transport, shape.form.value, shape.encoding.value) for shape in shapes
        )
        return StreamReading(
            clients=dict(kinds),
            sent=self._counts.sent,
            skipped=self._counts.skipped + sum(one.place.left_out for one in clients),
            closed={str(why): count for why, count in self._counts.closed.items()},
            encoded=self._press.written,
        )

    def _ensure_running(self) -> None:
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._run())
            self._task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        """Let everybody go where the task broke: they come back, and it begins anew."""
        if task.cancelled() or task.exception() is None:
            return
        logger.error("the live stream broke (%s); every client is let go", type(task.exception()).__name__)
        for client in tuple(self._clients):
            client.end("failed")

    async def _run(self) -> None:
        while self._clients:
            now_s = self._now_s()
            self._look(now_s)
            if self.newest is None and now_s >= self._idle_s:
                self._idle_s = now_s + IDLE_S
                self._say(Plain(Idle(sent_at=self.clock.utc()), self._press))
            if now_s >= self._tended_s + TEND_S:
                self._tend(now_s)
            for client in self._clients:
                if client.place.period_s is not None:
                    client.place.tick(now_s)
            await anyio.sleep(POLL_S)

    def _look(self, now_s: float) -> None:
        """See whether there is news, and put it into every place."""
        live = self._runner.newest()
        if live is self._last:
            return
        before, self._last = self._last, live
        if live is None:
            self.newest = None
            return
        self.newest = frame = self._frame(live, None if before is None else before.message)
        for client in self._clients:
            client.place.offer(frame, now_s)

    def _frame(self, live: LiveFrame, before: Sample | None) -> Frame:
        now = live.message
        step = 1 if before is None or before.session_id != now.session_id else now.frame_index - before.frame_index
        missed = max(step - 1, 0) if self._task is not None and not self._task.done() else 0
        self._sequence += 1 + missed
        return Frame(
            live,
            sequence=self._sequence,
            is_change=before is None or _gate(before) != _gate(now),
            is_repeat=step == 0,
            missed=missed,
            press=self._press,
        )

    def _say(self, spoken: Plain) -> None:
        for client in self._clients:
            client.place.say(spoken)

    def _tend(self, now_s: float) -> None:
        """Look at every client: may it stay, does it take what it is sent, has it heard of us of late."""
        self._tended_s = now_s
        ping = Plain(Ping(sent_at=self.clock.utc()), self._press)
        for client in tuple(self._clients):
            place = client.place
            if self._is_leaving:
                client.end("leaving")
            elif place.busy_since_s is not None:
                if now_s > place.busy_since_s + self._stall_s:
                    client.end("stalled")
            elif now_s >= place.said_s + PING_S:
                place.say(ping)
            if now_s >= client.checked_s + CHECK_S:
                client.checked_s = now_s
                if not client.may_stay():
                    client.end("not_logged_in")


def _gate(sample: Sample) -> tuple[object, ...]:
    """Return what is told at once, however low a rate was asked for."""
    return (
        sample.session_id,
        sample.session_status,
        sample.gate,
        sample.hold_reason,
        sample.line_on,
        sample.is_armed,
    )
