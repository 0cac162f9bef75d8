"""``/api/v1/coach/live``: the coaching stream as a WebSocket, for patient screens and the console's mirror."""

import contextlib
from typing import cast

import anyio
from fastapi import APIRouter, WebSocket
from starlette.websockets import WebSocketDisconnect

from service.core.schemas.coach_messages import CoachHello, CoachMessage
from service.web.dependencies import access, caller, require_guarded
from service.web.stream.coach_hub import CoachClient, CoachHub
from service.web.stream.encoding import Shape
from service.web.stream.query import Encoding, Form
from service.web.stream.transports import CLOSE_CODES, SocketConnection

router = APIRouter()
SHAPE = Shape("websocket", Form.FULL, Encoding.JSON)


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
