"""The hub: one task reads each new frame once and queues it for every client.

The task runs on the event loop while there are clients, and never waits for one: a slow client gets the newest frame
when it is ready, and a client that reads nothing for too long is disconnected.
"""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import anyio

from service.core.schemas.live_messages import Alarms, Idle, Ping, Sample
from service.engine_host.protocols import LiveFeed, LiveFrame
from service.sessions.alarms.board import AlarmBoard, live_alarm_event, live_alarms
from service.web.stream.client_slot import ClientSlot
from service.web.stream.encoding import Frame, MessageEncoder, Plain, Shape, StreamClock
from service.web.stream.metrics import CloseReason, StreamCounts, StreamReading

logger = logging.getLogger(__name__)

POLL_S = 0.003
IDLE_S = 0.5
PING_S = 1.0
CLIENT_CHECK_S = 0.25
LOGIN_CHECK_S = 1.0
"""Period of checking that a client's log-in is valid; the check counts as use of the log-in."""
MayWatch = Callable[[], bool]


@dataclass(slots=True, eq=False)
class Client:
    """A connected client."""

    slot: ClientSlot
    may_watch: MayWatch
    scope: anyio.CancelScope
    checked_s: float
    why: CloseReason = "gone"

    def end(self, why: CloseReason) -> None:
        """Disconnect the client for a reason; the first counts, though closing takes time and there may be others."""
        if not self.scope.cancel_called:
            self.why = why
            self.scope.cancel()


class LiveHub:
    """The connected clients, and the task that distributes new frames."""

    def __init__(
        self,
        runner: LiveFeed,
        alarms: AlarmBoard,
        *,
        max_clients: int,
        stall_s: float,
        now_s: Callable[[], float] | None = None,
        room: str = "",
    ) -> None:
        self.room = room
        self._runner = runner
        self._alarms = alarms
        self._max_clients = max_clients
        self._stall_s = stall_s
        self._now_s = now_s or (lambda: asyncio.get_running_loop().time())
        self.clock = StreamClock(now_s=self._now_s, now_ns=runner.now_ns)
        self._encoder = MessageEncoder(self.clock)
        self._clients: set[Client] = set()
        self._counts = StreamCounts()
        self._task: asyncio.Task[None] | None = None
        self._is_shutting_down = False
        self._last: LiveFrame | None = None
        self._alarm_event = 0
        self._sequence = -1
        self._idle_s = self._checked_s = 0.0
        self.newest: Frame | None = None

    @contextmanager
    def connect(
        self, shape: Shape, *, rate_hz: float | None, may_watch: MayWatch, buffers: bool = False
    ) -> Iterator[Client | None]:
        """Register a client for the duration of the block; yield None if the stream is full. Event loop only.

        With ``holds`` frames are buffered until the missed samples are sent.
        """
        if len(self._clients) >= self._max_clients or self._is_shutting_down:
            self._counts.closed["full"] += 1
            yield None
            return
        now_s = self._now_s()
        slot = ClientSlot(shape, rate_hz=rate_hz, now_s=now_s)
        if buffers:
            slot.start_buffering()
        client = Client(slot=slot, may_watch=may_watch, scope=anyio.CancelScope(), checked_s=now_s)
        self._distribute_newest(now_s)  # the last frame may be from the time of an earlier client
        self._distribute_alarms()  # the same with events: this client gets the active alarms instead
        self._clients.add(client)
        self._queue_active_alarms(slot)
        if self.newest is not None:
            slot.offer(self.newest, now_s)
            slot.reset_skipped()  # they are from before the client connected
        self._ensure_running()
        try:
            yield client
        finally:
            self._clients.discard(client)
            self._counts.skipped += slot.total_skipped
            self._counts.closed[client.why] += 1

    def shut_down(self) -> None:
        """Disconnect all clients at the next check, because the service ends. Thread-safe."""
        self._is_shutting_down = True

    def sent(self) -> None:
        """Count a sent message."""
        self._counts.sent += 1

    def now_s(self) -> float:
        """Return the time of the stream's clock [s]."""
        return self._now_s()

    def running(self) -> Sample | None:
        """Return the newest sample of the running session, or None."""
        return None if self.newest is None else self.newest.live.message

    def reading(self) -> StreamReading:
        """Return the counters. Thread-safe."""
        clients = list(self._clients)
        shapes = (one.slot.shape for one in clients)
        kinds: Counter[tuple[str, str]] = Counter((shape.transport, shape.form.value) for shape in shapes)
        return StreamReading(
            clients=dict(kinds),
            sent=self._counts.sent,
            skipped=self._counts.skipped + sum(one.slot.total_skipped for one in clients),
            closed={str(why): count for why, count in self._counts.closed.items()},
            encoded=self._encoder.encoded_count,
        )

    def _ensure_running(self) -> None:
        if self._task is None or self._task.done():
            self._task = asyncio.get_running_loop().create_task(self._run())
            self._task.add_done_callback(self._ended)

    def _ended(self, task: asyncio.Task[None]) -> None:
        """Disconnect all clients if the task failed; they reconnect, which starts a new task."""
        if task.cancelled() or task.exception() is None:
            return
        logger.error("the live stream failed (%s); all clients are disconnected", type(task.exception()).__name__)
        for client in tuple(self._clients):
            client.end("failed")

    async def _run(self) -> None:
        while self._clients:
            now_s = self._now_s()
            self._distribute_alarms()
            self._distribute_newest(now_s)
            if self.newest is None and now_s >= self._idle_s:
                self._idle_s = now_s + IDLE_S
                self._broadcast(Plain(Idle(sent_at=self.clock.utc()), self._encoder))
            if now_s >= self._checked_s + CLIENT_CHECK_S:
                self._check_clients(now_s)
            for client in self._clients:
                if client.slot.period_s is not None:
                    client.slot.tick(now_s)
            await anyio.sleep(POLL_S)

    def _distribute_newest(self, now_s: float) -> None:
        """Queue a new frame for every client, if there is one."""
        live = self._runner.newest()
        if live is self._last:
            return
        before, self._last = self._last, live
        if live is None:
            self.newest = None
            return
        self.newest = frame = self._frame(live, None if before is None else before.message)
        for client in self._clients:
            client.slot.offer(frame, now_s)

    def _distribute_alarms(self) -> None:
        """Queue every new event of the alarms for every client, each with the alarms that are active after it."""
        for event in self._alarms.events_after(self._alarm_event):
            self._alarm_event = event.number
            if not self._clients:
                continue
            message = Alarms(sent_at=self.clock.utc(), event=live_alarm_event(event), active=live_alarms(event.active))
            shared = Plain(message, self._encoder)
            for client in self._clients:
                client.slot.queue_alarms(shared)

    def _queue_active_alarms(self, slot: ClientSlot) -> None:
        active = live_alarms(self._alarms.active)
        if active:
            message = Alarms(sent_at=self.clock.utc(), event=None, active=active)
            slot.queue_alarms(Plain(message, self._encoder))

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
            encoder=self._encoder,
        )

    def _broadcast(self, message: Plain) -> None:
        for client in self._clients:
            client.slot.queue_message(message)

    def _check_clients(self, now_s: float) -> None:
        """Disconnect clients that are stalled or logged out; ping those without a message, recent or queued."""
        self._checked_s = now_s
        ping = Plain(Ping(sent_at=self.clock.utc()), self._encoder)
        for client in tuple(self._clients):
            slot = client.slot
            if self._is_shutting_down:
                client.end("leaving")
            elif slot.busy_since_s is not None:
                if now_s > slot.busy_since_s + self._stall_s:
                    client.end("stalled")
            elif now_s >= slot.last_sent_s + PING_S and not slot.ready.is_set():
                slot.queue_message(ping)
            if now_s >= client.checked_s + LOGIN_CHECK_S:
                client.checked_s = now_s
                if not client.may_watch():
                    client.end("not_logged_in")


def _gate(sample: Sample) -> tuple[object, ...]:
    """Return the values whose change is sent at once, whatever rate was requested."""
    return (
        sample.session_id,
        sample.session_status,
        sample.gate,
        sample.hold_reason,
        sample.line_on,
        sample.is_armed,
    )
