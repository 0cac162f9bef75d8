"""``/api/v1/live``: the stream as a WebSocket."""

from typing import cast

from fastapi import APIRouter, WebSocket
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.datastructures import QueryParams

from service.web.dependencies import access, caller, require_guarded, services
from service.web.problems.table import problem_of, problem_response
from service.web.stream.encoding import Shape, StreamQuery
from service.web.stream.feed import hello_of, serve
from service.web.stream.hub import LiveHub
from service.web.stream.resume import Resumption
from service.web.stream.transports import CLOSE_CODES, POLICY_VIOLATION, SocketConnection

router = APIRouter()
REASON_BYTES = 120
"""A WebSocket close reason may have 123 bytes."""


@router.websocket("/live")
async def live(websocket: WebSocket) -> None:
    """Stream live messages: `hello`, missed samples on request, then live; see docs/4-integrate/stream.md."""
    require_guarded(websocket)
    try:
        query = read_query(websocket.query_params)
    except RequestValidationError as error:
        await _refuse(websocket, error)
        return
    hub = cast("LiveHub", websocket.app.state.live)
    identity, authenticator = caller(websocket).identity, access(websocket).authenticator
    shape = Shape("websocket", query.form)
    resume = cast("Resumption", websocket.app.state.resumption).for_query(query)
    with hub.connect(
        shape,
        rate_hz=query.rate_hz,
        may_watch=lambda: authenticator.is_valid(identity),
        buffers=resume is not None,
    ) as client:
        await websocket.accept()
        if client is None:
            await websocket.close(CLOSE_CODES["full"], "full")
            return
        connection = SocketConnection(websocket, shape)
        await serve(hub, client, connection, hello_of(hub, services(websocket).runner, query, shape), resume)


def read_query(parameters: QueryParams) -> StreamQuery:
    """Parse the query; raise RequestValidationError for unknown, repeated or out-of-bound parameters."""
    given: dict[str, object] = {}
    for name, value in parameters.multi_items():
        given[name] = [*parameters.getlist(name)] if len(parameters.getlist(name)) > 1 else value
    try:
        return StreamQuery.model_validate(given)
    except ValidationError as error:
        found = [{**one, "loc": ("query", *one["loc"])} for one in error.errors(include_url=False)]
        raise RequestValidationError(found) from error


async def _refuse(websocket: WebSocket, error: RequestValidationError) -> None:
    """Answer the handshake with the problem; if the server cannot, close with its code as the reason."""
    problem = problem_of(error)
    if "websocket.http.response" in websocket.scope.get("extensions", {}):
        await websocket.send_denial_response(problem_response(problem))
        return
    reason = f"{problem.code}: {problem.detail}".encode()[:REASON_BYTES].decode(errors="ignore")
    await websocket.close(POLICY_VIOLATION, reason)
