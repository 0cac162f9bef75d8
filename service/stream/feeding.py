"""One client's stream: hello, what it missed, then what there is, until it goes or has to."""

import contextlib
from collections.abc import Awaitable, Callable
from typing import Protocol

import anyio
from starlette.websockets import WebSocketDisconnect

from engine import __version__
from service.live_messages import Dropped, Hello, Message
from service.ports import RunnerPort
from service.stream.asking import EventsQuery
from service.stream.counts import Why
from service.stream.hub import PING_S, Client, LiveHub
from service.stream.spoken import Frame, Shape, Spoken, written
from service.uncalibrated import kind_of, warning_of


class Wire(Protocol):
    """The way to one client."""

    @property
    def shape(self) -> Shape:
        """How it gets its messages."""

    async def send(self, payload: str | bytes) -> None:
        """Send; returns once there is room for more. Raise WebSocketDisconnect or OSError where it has gone."""

    async def listen(self) -> bool:
        """Wait until the client goes, or says so much that it has to: then false."""

    async def close(self, why: Why) -> None:
        """Say why, and end the connection; by force where it does not take even that."""


Resume = Callable[["Feed"], Awaitable[None]]


class Feed:
    """What goes to one client."""

    def __init__(self, hub: LiveHub, client: Client, wire: Wire) -> None:
        self.hub = hub
        self.client = client
        self.place = client.place
        self._wire = wire

    async def run(self, hello: Hello, resume: Resume | None) -> None:
        """Send until something ends it."""
        await self.tell(hello)
        if resume is not None:
            await resume(self)
        while True:
            await self.place.news.wait()
            spoken = self.place.take(self.hub.now_s())
            if spoken is not None:
                await self.give(spoken)

    async def give(self, spoken: Spoken) -> None:
        """Send what was made for all; before a sample, tell how many were left out."""
        if self.place.skipped and isinstance(spoken, Frame):
            skipped, changes = self.place.told_skipped()
            await self.tell(Dropped(sent_at=self.hub.clock.utc(), skipped=skipped, gate_changes=changes))
        await self._put(spoken.payload(self._wire.shape))

    async def tell(self, message: Message) -> None:
        """Send a message to this client alone."""
        await self._put(written(message, self._wire.shape))

    async def put(self, payload: str | bytes) -> None:
        """Send what was written already."""
        await self._put(payload)

    async def _put(self, payload: str | bytes) -> None:
        place = self.place
        place.busy_since_s = place.said_s = self.hub.now_s()
        await self._wire.send(payload)
        place.busy_since_s = None
        self.hub.sent()


async def serve(hub: LiveHub, client: Client, wire: Wire, hello: Hello, resume: Resume | None) -> None:
    """Feed one client until it goes, or has to."""
    feed = Feed(hub, client, wire)
    with client.scope:
        async with anyio.create_task_group() as tasks:

            async def listen() -> None:
                client.end("gone" if await wire.listen() else "chatty")

            tasks.start_soon(listen)
            with contextlib.suppress(WebSocketDisconnect, OSError):
                await feed.run(hello, resume)
            client.end("gone")
    if client.why != "gone":
        await wire.close(client.why)


def hello_of(hub: LiveHub, runner: RunnerPort, query: EventsQuery, shape: Shape) -> Hello:
    """Say how the stream understood the client, and what there is to see."""
    running, camera = hub.running(), runner.running_camera()
    return Hello(
        version=__version__,
        sent_at=hub.clock.utc(),
        form=shape.form.value,
        encoding=shape.encoding.value,
        rate_hz=query.rate_hz,
        camera_fps=None if running is None else running.fps,
        session_id=None if running is None else running.session_id,
        resumes_after=query.after_frame,
        ping_s=PING_S,
        calibration=None if camera is None else kind_of(camera),
        calibration_warning=None if camera is None else warning_of(camera),
    )
