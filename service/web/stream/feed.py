"""The stream of one client: hello, missed samples on request, then live messages until the connection ends."""

import contextlib
from collections.abc import Awaitable, Callable
from typing import Protocol

import anyio
from starlette.websockets import WebSocketDisconnect

from engine import __version__
from service.core.schemas.live_messages import Dropped, Hello, Message
from service.engine_host.protocols import LiveFeed
from service.engine_host.site_limits.calibrations import kind_of, warning_of
from service.web.stream.encoding import EncodedMessage, Frame, Shape, StreamQuery, encode
from service.web.stream.hub import PING_S, Client, LiveHub
from service.web.stream.metrics import CloseReason

Resume = Callable[["Feed"], Awaitable[None]]


class ClientConnection(Protocol):
    """The connection to one client."""

    @property
    def shape(self) -> Shape:
        """Shape of the client's messages."""

    async def send(self, payload: str | bytes) -> None:
        """Send and wait until there is room for more; raise WebSocketDisconnect or OSError if the client is gone."""

    async def listen(self) -> bool:
        """Wait until the client disconnects; return False if it sent too many messages."""

    async def close(self, why: CloseReason) -> None:
        """Close the connection with the reason; abort it if the client does not read that either."""


class Feed:
    """Sends messages to one client."""

    def __init__(self, hub: LiveHub, client: Client, connection: ClientConnection) -> None:
        self.hub = hub
        self.client = client
        self.slot = client.slot
        self._connection = connection

    async def run(self, hello: Hello, resume: Resume | None) -> None:
        """Send messages until cancelled or disconnected."""
        await self.send(hello)
        await self.send_alarms()
        if resume is not None:
            await resume(self)
        while True:
            await self.slot.ready.wait()
            message = self.slot.take(self.hub.now_s())
            if message is not None:
                await self.send_shared(message)

    async def send_alarms(self) -> None:
        """Send the waiting messages about alarms: nothing else delays them."""
        while (message := self.slot.take_alarms()) is not None:
            await self.send_payload(message.payload(self._connection.shape))

    async def send_shared(self, message: EncodedMessage) -> None:
        """Send a shared message; before a frame, send the number of dropped samples."""
        if self.slot.skipped and isinstance(message, Frame):
            skipped, changes = self.slot.take_skipped()
            await self.send(Dropped(sent_at=self.hub.clock.utc(), skipped=skipped, gate_changes=changes))
        await self.send_payload(message.payload(self._connection.shape))

    async def send(self, message: Message) -> None:
        """Encode and send a message for this client only."""
        await self.send_payload(encode(message, self._connection.shape))

    async def send_payload(self, payload: str | bytes) -> None:
        """Send encoded bytes."""
        slot = self.slot
        slot.busy_since_s = slot.last_sent_s = self.hub.now_s()
        await self._connection.send(payload)
        slot.busy_since_s = None
        self.hub.sent()


async def serve(
    hub: LiveHub, client: Client, connection: ClientConnection, hello: Hello, resume: Resume | None
) -> None:
    """Serve one client until it disconnects or is disconnected."""
    feed = Feed(hub, client, connection)
    with client.scope:
        async with anyio.create_task_group() as tasks:

            async def listen() -> None:
                client.end("gone" if await connection.listen() else "chatty")

            tasks.start_soon(listen)
            with contextlib.suppress(WebSocketDisconnect, OSError):
                await feed.run(hello, resume)
            client.end("gone")
    if client.why != "gone":
        await connection.close(client.why)


def hello_of(hub: LiveHub, runner: LiveFeed, query: StreamQuery, shape: Shape) -> Hello:
    """Return the hello message: the request as understood, and the running session."""
    running, camera = hub.running(), runner.running_camera()
    return Hello(
        version=__version__,
        room=hub.room or None,
        sent_at=hub.clock.utc(),
        form=shape.form.value,
        rate_hz=query.rate_hz,
        camera_fps=None if running is None else running.fps,
        session_id=None if running is None else running.session_id,
        resumes_after=query.after_frame,
        ping_s=PING_S,
        calibration=None if camera is None else kind_of(camera),
        calibration_warning=None if camera is None else warning_of(camera),
    )
