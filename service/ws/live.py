"""``/api/v1/live``: the newest frame to everyone who watches; a slow client skips frames, and nobody waits for it."""

from collections.abc import Callable
from datetime import UTC, datetime
from typing import cast

import anyio
from fastapi import APIRouter, WebSocket
from starlette.websockets import WebSocketDisconnect

from engine import __version__
from service.deps import access, caller, require_guarded, services
from service.live_messages import Hello, Idle, Message
from service.ports import RunnerPort
from service.uncalibrated import kind_of, warning_of

router = APIRouter()

POLL_S = 0.004
IDLE_S = 0.5
CHECK_S = 1.0
"""How often the stream asks whether who opened it may still watch; it counts as using the log-in, too."""
SEND_TIMEOUT_S = 5.0
POLICY_VIOLATION = 1008
TRY_AGAIN_LATER = 1013
MayStay = Callable[[], bool]


class LiveStream:
    """Counts its clients and feeds each the newest there is."""

    def __init__(self, *, max_clients: int) -> None:
        self._max_clients = max_clients
        self._clients = 0

    async def serve(self, websocket: WebSocket, runner: RunnerPort, may_stay: MayStay) -> None:
        """Feed one client until it goes, or may not stay; the guard has looked at who it is, and from which page."""
        await websocket.accept()
        if self._clients >= self._max_clients:
            await websocket.close(TRY_AGAIN_LATER, f"at most {self._max_clients} clients")
            return
        self._clients += 1
        try:
            await _feed_until_gone(websocket, runner, may_stay)
        finally:
            self._clients -= 1


@router.websocket("/live")
async def live(websocket: WebSocket) -> None:
    """Send `hello`, then `sample`s, or `idle` twice a second while no session runs."""
    stream = cast("LiveStream", websocket.app.state.live)
    require_guarded(websocket)
    identity, doorkeeper = caller(websocket).identity, access(websocket).doorkeeper
    await stream.serve(websocket, services(websocket).runner, lambda: doorkeeper.is_valid(identity))


async def _feed_until_gone(websocket: WebSocket, runner: RunnerPort, may_stay: MayStay = lambda: True) -> None:
    async with anyio.create_task_group() as tasks:

        async def listen() -> None:
            """Notice the client going; nothing it says matters."""
            while (await websocket.receive())["type"] != "websocket.disconnect":
                pass
            tasks.cancel_scope.cancel()

        tasks.start_soon(listen)
        try:
            await _feed(websocket, runner, may_stay)
            with anyio.move_on_after(SEND_TIMEOUT_S):
                await websocket.close(POLICY_VIOLATION, "not_logged_in")
            tasks.cancel_scope.cancel()
        except (WebSocketDisconnect, TimeoutError):
            tasks.cancel_scope.cancel()


async def _feed(websocket: WebSocket, runner: RunnerPort, may_stay: MayStay) -> None:
    """Send until the log-in, or the key, that opened the stream is over."""
    await _send(websocket, _hello(runner.running_camera()))
    last = None
    sequence = 0
    idle_at_s = anyio.current_time()
    checked_s = anyio.current_time()
    while True:
        if anyio.current_time() >= checked_s + CHECK_S:
            checked_s = anyio.current_time()
            if not may_stay():
                return
        newest = runner.newest()
        if newest is not None and newest is not last:
            last = newest
            age_ms = round((runner.now_ns() - newest.received_ns) / 1e6, 2)
            update = {"sequence": sequence, "sent_at": datetime.now(UTC), "age_ms": age_ms}
            await _send(websocket, newest.message.model_copy(update=update))
            sequence += 1
        elif newest is None and anyio.current_time() >= idle_at_s:
            await _send(websocket, Idle(sent_at=datetime.now(UTC)))
            idle_at_s = anyio.current_time() + IDLE_S
        await anyio.sleep(POLL_S)


def _hello(camera: str | None) -> Hello:
    if camera is None:
        return Hello(version=__version__)
    return Hello(version=__version__, calibration=kind_of(camera), calibration_warning=warning_of(camera))


async def _send(websocket: WebSocket, message: Message) -> None:
    with anyio.fail_after(SEND_TIMEOUT_S):
        # Of the messages only `hello` leaves anything out: what it would say of a session when none runs.
        await websocket.send_text(message.model_dump_json(exclude_none=isinstance(message, Hello)))
