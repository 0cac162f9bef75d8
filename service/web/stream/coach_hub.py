"""The coaching stream: one task reads each new frame; every client gets the newest, however slow it is.

``/api/v1/coach/live``: the coaching stream as a WebSocket, for patient screens and the console's mirror.
"""

import asyncio
import contextlib
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import cast

import anyio
from fastapi import APIRouter, WebSocket
from starlette.websockets import WebSocketDisconnect

from engine.core.clock import NS_PER_MS
from service.core.schemas.coaching import CoachBand, CoachGuide, CoachHello, CoachMessage, CoachWait
from service.engine_host.protocols import LiveFeed, LiveFrame
from service.sessions.coaching.board import CoachingBoard, Guidance
from service.web.dependencies import access, caller, require_guarded
from service.web.stream.encoding import Form, Shape, StreamClock
from service.web.stream.hub import CLIENT_CHECK_S, LOGIN_CHECK_S, POLL_S, MayWatch
from service.web.stream.metrics import CloseReason
from service.web.stream.transports import CLOSE_CODES, SocketConnection

logger = logging.getLogger(__name__)
WAIT_S = 0.1
"""Period of messages while nothing is shown; a screen is black after 300 ms without one."""
MAX_CLIENTS = 16
router = APIRouter()
SHAPE = Shape("websocket", Form.FULL)


@dataclass(frozen=True, slots=True, kw_only=True)
class CoachFrame:
    """What is newest: the guidance of a frame, or None where nothing is shown."""

    sequence: int
    guidance: Guidance | None = None
    received_ns: int = 0


@dataclass(slots=True, eq=False)
class CoachClient:
    """A connected screen or mirror, with the one message that waits for it."""

    may_watch: MayWatch
    scope: anyio.CancelScope
    checked_s: float
    ready: asyncio.Event = field(default_factory=asyncio.Event)
    newest: CoachFrame | None = None
    busy_since_s: float | None = None
    why: CloseReason = "gone"

    def offer(self, frame: CoachFrame) -> None:
        """Replace the message that waits."""
        self.newest = frame
        self.ready.set()

    async def take(self) -> CoachFrame:
        """Wait for a message and remove it."""
        await self.ready.wait()
        self.ready.clear()
        frame, self.newest = self.newest, None
        assert frame is not None, "it is offered before the event is set"
        return frame

    def end(self, why: CloseReason) -> None:
        """Disconnect for a reason; the first counts."""
        if not self.scope.cancel_called:
            self.why = why
            self.scope.cancel()


class CoachHub:
    """The connected clients of the coaching stream; event loop only, except `shut_down`."""

    def __init__(
        self,
        feed: LiveFeed,
        board: CoachingBoard,
        *,
        stall_s: float,
        now_s: Callable[[], float] | None = None,
    ) -> None:
        self._feed, self._board = feed, board
        self._stall_s = stall_s
        self._now_s = now_s or (lambda: asyncio.get_running_loop().time())
        self._clock = StreamClock(now_s=self._now_s, now_ns=feed.now_ns)
        self._clients: set[CoachClient] = set()
        self._task: asyncio.Task[None] | None = None
        self._is_shutting_down = False
        self._last: LiveFrame | None = None
        self._is_guiding = False
        self._sequence = 0
        self._wait_s = self._checked_s = 0.0

    @property
    def client_count(self) -> int:
        """Number of connected clients."""
        return len(self._clients)

    @contextmanager
    def connect(self, may_watch: MayWatch) -> Iterator[CoachClient | None]:
        """Register a client for the duration of the block; yield None if there are too many."""
        if len(self._clients) >= MAX_CLIENTS or self._is_shutting_down:
            yield None
            return
        client = CoachClient(may_watch=may_watch, scope=anyio.CancelScope(), checked_s=self._now_s())
        self._clients.add(client)
        if self._task is None or self._task.done():
            self._last = None  # so that the present frame is sent
            self._task = asyncio.get_running_loop().create_task(self._run())
            self._task.add_done_callback(self._ended)
        try:
            yield client
        finally:
            self._clients.discard(client)

    def shut_down(self) -> None:
        """Disconnect all clients at the next check, because the service ends. Thread-safe."""
        self._is_shutting_down = True

    def message(self, frame: CoachFrame) -> CoachGuide | CoachWait:
        """Return the message of a frame, with the age that it has now."""
        sent_at = self._clock.utc()
        guidance = frame.guidance
        if guidance is None:
            return CoachWait(sequence=frame.sequence, sent_at=sent_at, language=self._board.language)
        guide, settings = guidance.frame, guidance.settings
        band = None if guide.band is None else CoachBand(lower=guide.band.lower, upper=guide.band.upper)
        return CoachGuide(
            sequence=frame.sequence,
            sent_at=sent_at,
            age_ms=round(max(self._clock.now_ns() - frame.received_ns, 0) / NS_PER_MS, 2),
            is_practice=settings.is_practice,
            is_measured=guide.level is not None,
            level=guide.level,
            band=band,
            instruction=guide.instruction,
            countdown_s=guide.countdown_s,
            display=settings.display,
            sounds=settings.sounds,
            language=settings.language,
        )

    def now_s(self) -> float:
        """Return the time of the stream's clock [s]."""
        return self._now_s()

    def _ended(self, task: asyncio.Task[None]) -> None:
        """Disconnect all clients if the task failed; they reconnect, which starts a new task."""
        if task.cancelled() or task.exception() is None:
            return
        logger.error("the coaching stream failed (%s); all screens are disconnected", type(task.exception()).__name__)
        for client in tuple(self._clients):
            client.end("failed")

    async def _run(self) -> None:
        while self._clients:
            now_s = self._now_s()
            self._distribute(now_s)
            if now_s >= self._checked_s + CLIENT_CHECK_S:
                self._check_clients(now_s)
            await anyio.sleep(POLL_S)

    def _distribute(self, now_s: float) -> None:
        """Offer a new frame to every client; between frames send nothing, so that a screen goes black by itself."""
        live = self._feed.newest()
        if live is not None and live is not self._last:
            guidance = self._board.guidance(live)
            self._is_guiding = guidance is not None
            if guidance is not None:
                self._offer(guidance, live.received_ns)
        elif live is None:
            self._is_guiding = False
        self._last = live
        if not self._is_guiding and now_s >= self._wait_s:
            self._wait_s = now_s + WAIT_S
            self._offer(None, 0)

    def _offer(self, guidance: Guidance | None, received_ns: int) -> None:
        self._sequence += 1
        frame = CoachFrame(sequence=self._sequence, guidance=guidance, received_ns=received_ns)
        for client in self._clients:
            client.offer(frame)

    def _check_clients(self, now_s: float) -> None:
        """Disconnect clients that read nothing or may not watch any more."""
        self._checked_s = now_s
        for client in tuple(self._clients):
            if self._is_shutting_down:
                client.end("leaving")
            elif client.busy_since_s is not None and now_s > client.busy_since_s + self._stall_s:
                client.end("stalled")
            elif now_s >= client.checked_s + LOGIN_CHECK_S:
                client.checked_s = now_s
                if not client.may_watch():
                    client.end("not_logged_in")


@router.websocket("/coach/live")
async def coach_live(websocket: WebSocket) -> None:
    """Stream the newest guidance: `hello`, then `guide` with every frame or `wait`; see docs/4-integrate/stream.md."""
    require_guarded(websocket)
    hub = cast("CoachHub", websocket.app.state.coach)
    identity, authenticator = caller(websocket).identity, access(websocket).authenticator
    with hub.connect(lambda: authenticator.is_valid(identity)) as client:
        await websocket.accept()
        if client is None:
            await websocket.close(CLOSE_CODES["full"], "full")
            return
        await _serve(hub, client, SocketConnection(websocket, SHAPE))


async def _serve(hub: CoachHub, client: CoachClient, connection: SocketConnection) -> None:
    """Serve one client until it disconnects or is disconnected."""
    with client.scope:
        async with anyio.create_task_group() as tasks:

            async def listen() -> None:
                client.end("gone" if await connection.listen() else "chatty")

            tasks.start_soon(listen)
            with contextlib.suppress(WebSocketDisconnect, OSError):
                await _send(hub, client, connection, CoachHello())
                while True:
                    await _send(hub, client, connection, hub.message(await client.take()))
            client.end("gone")
    if client.why != "gone":
        await connection.close(client.why)


async def _send(hub: CoachHub, client: CoachClient, connection: SocketConnection, message: CoachMessage) -> None:
    client.busy_since_s = hub.now_s()
    await connection.send(message.model_dump_json())
    client.busy_since_s = None
