"""``/api/v1/live/events``: the stream as server-sent events, for those without sockets."""

from typing import Annotated, Any, cast

from fastapi import APIRouter, Header, Query, Request
from fastapi.responses import Response
from starlette.types import Receive, Scope, Send

from service.api import problems
from service.deps import access, caller, services
from service.errors import StreamFullError
from service.ports import RunnerPort
from service.problems import problem_of, problem_response
from service.stream.asking import Encoding, EventsQuery
from service.stream.feeding import Resume, hello_of, serve
from service.stream.hub import LiveHub, MayStay
from service.stream.resuming import Resumption
from service.stream.spoken import Shape
from service.stream.wires import EventsWire

router = APIRouter(tags=["live"])
EVENT_ID = r"^([0-9a-f]{32}):(\d{1,16})$"
EXAMPLE = 'event: idle\ndata: {"type":"idle","sent_at":"2026-11-22T01:00:00Z"}\n\n'
STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "Events without an end, as docs/stream.md and openapi/asyncapi.json have them",
        "content": {"text/event-stream": {"schema": {"type": "string"}, "example": EXAMPLE}},
    }
}


class EventStream(Response):
    """An answer that goes on until the client goes."""

    media_type = "text/event-stream"

    def __init__(
        self, hub: LiveHub, runner: RunnerPort, query: EventsQuery, may_stay: MayStay, resume: Resume | None
    ) -> None:
        super().__init__()
        self._resume = resume
        self._hub = hub
        self._runner = runner
        self._query = query
        self._may_stay = may_stay

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Feed the client, where there is a place."""
        shape = Shape("sse", self._query.form, Encoding.JSON)
        with self._hub.enter(
            shape, rate_hz=self._query.rate_hz, may_stay=self._may_stay, holds=self._resume is not None
        ) as client:
            if client is None:
                error = StreamFullError()
                await problem_response(problem_of(error), error.headers)(scope, receive, send)
                return
            wire = EventsWire(scope, receive, send, self._query.form)
            await wire.begin()
            await serve(self._hub, client, wire, hello_of(self._hub, self._runner, self._query, shape), self._resume)


@router.get(
    "/live/events",
    response_class=Response,
    responses={**STREAM, **problems(StreamFullError)},
)
async def stream_events(
    request: Request,
    query: Annotated[EventsQuery, Query()],
    last_event_id: Annotated[
        str | None,
        Header(pattern=EVENT_ID, description="As a browser sends it when it comes back: go on after this event"),
    ] = None,
) -> EventStream:
    """Send what goes on as server-sent events: `event` is the message's type, `data` the message, `id` a frame.

    Comments come where nothing else does. The answer ends when the log-in does.
    """
    if last_event_id is not None:
        session_id, _, index = last_event_id.partition(":")
        query = query.model_copy(update={"session_id": session_id, "after_frame": int(index)})
    identity, doorkeeper = caller(request).identity, access(request).doorkeeper
    hub = cast("LiveHub", request.app.state.live)
    resume = cast("Resumption", request.app.state.resumption).asked(query)
    return EventStream(hub, services(request).runner, query, lambda: doorkeeper.is_valid(identity), resume)
