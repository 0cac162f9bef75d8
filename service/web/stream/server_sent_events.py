"""``/api/v1/live/events``: the stream as server-sent events, for clients without WebSockets."""

from typing import Annotated, Any, cast

from fastapi import APIRouter, Header, Query, Request
from fastapi.responses import Response
from starlette.types import Receive, Scope, Send

from service.core.errors import StreamFullError
from service.engine_host.protocols import LiveFeed
from service.web.dependencies import access, caller, services
from service.web.problems.table import problem_of, problem_response
from service.web.stream.encoding import Shape, StreamQuery
from service.web.stream.feed import Resume, hello_of, serve
from service.web.stream.hub import LiveHub, MayWatch
from service.web.stream.resume import Resumption
from service.web.stream.transports import EventsConnection

router = APIRouter(tags=["live"])
EVENT_ID = r"^([0-9a-f]{32}):(\d{1,16})$"
EXAMPLE = 'event: idle\ndata: {"type":"idle","sent_at":"2026-11-22T01:00:00Z"}\n\n'
STREAM: dict[int | str, dict[str, Any]] = {
    200: {
        "description": "An endless stream of events: docs/4-integrate/stream.md and openapi/live.schema.json",
        "content": {"text/event-stream": {"schema": {"type": "string"}, "example": EXAMPLE}},
    }
}


class EventStream(Response):
    """The streaming response."""

    media_type = "text/event-stream"

    def __init__(
        self, hub: LiveHub, runner: LiveFeed, query: StreamQuery, may_watch: MayWatch, resume: Resume | None
    ) -> None:
        super().__init__()
        self._resume = resume
        self._hub = hub
        self._runner = runner
        self._query = query
        self._may_watch = may_watch

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve the client, or answer 503 if the stream is full."""
        shape = Shape("sse", self._query.form)
        with self._hub.connect(
            shape, rate_hz=self._query.rate_hz, may_watch=self._may_watch, buffers=self._resume is not None
        ) as client:
            if client is None:
                error = StreamFullError()
                await problem_response(problem_of(error), error.headers)(scope, receive, send)
                return
            connection = EventsConnection(scope, receive, send, self._query.form)
            await connection.begin()
            await serve(
                self._hub, client, connection, hello_of(self._hub, self._runner, self._query, shape), self._resume
            )


@router.get(
    "/live/events",
    response_class=Response,
    responses={**STREAM},
)
async def stream_events(
    request: Request,
    query: Annotated[StreamQuery, Query()],
    last_event_id: Annotated[
        str | None,
        Header(pattern=EVENT_ID, description="Sent by browsers on reconnection: continue after this event"),
    ] = None,
) -> EventStream:
    """Stream live messages as server-sent events: `event` is the message type, `data` the message, `id` the frame.

    A comment is sent when there is no other message. The stream ends with the log-in.
    """
    if last_event_id is not None:
        session_id, _, index = last_event_id.partition(":")
        query = query.model_copy(update={"session_id": session_id, "after_frame": int(index)})
    identity, authenticator = caller(request).identity, access(request).authenticator
    hub = cast("LiveHub", request.app.state.live)
    resume = cast("Resumption", request.app.state.resumption).for_query(query)
    return EventStream(hub, services(request).runner, query, lambda: authenticator.is_valid(identity), resume)
