"""``/api/v1/live``: the stream as a WebSocket."""

from typing import cast

from fastapi import APIRouter, WebSocket
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError
from starlette.datastructures import QueryParams

from service.deps import access, caller, require_guarded, services
from service.problems import problem_of, problem_response
from service.stream.asking import LiveQuery
from service.stream.feeding import hello_of, serve
from service.stream.hub import LiveHub
from service.stream.resuming import Resumption
from service.stream.spoken import Shape
from service.stream.wires import CLOSE_CODES, POLICY_VIOLATION, SocketWire

router = APIRouter()
REASON_BYTES = 120
"""A close reason has at most 123."""


@router.websocket("/live")
async def live(websocket: WebSocket) -> None:
    """Send `hello`, what was missed where that was asked for, then what there is; see docs/stream.md."""
    require_guarded(websocket)
    try:
        query = read_query(websocket.query_params)
    except RequestValidationError as error:
        await _refuse(websocket, error)
        return
    hub = cast("LiveHub", websocket.app.state.live)
    identity, doorkeeper = caller(websocket).identity, access(websocket).doorkeeper
    shape = Shape("websocket", query.form, query.encoding)
    resume = cast("Resumption", websocket.app.state.resumption).asked(query)
    with hub.enter(
        shape,
        rate_hz=query.rate_hz,
        may_stay=lambda: doorkeeper.is_valid(identity),
        holds=resume is not None,
    ) as client:
        await websocket.accept()
        if client is None:
            await websocket.close(CLOSE_CODES["full"], "full")
            return
        wire = SocketWire(websocket, shape)
        await serve(hub, client, wire, hello_of(hub, services(websocket).runner, query, shape), resume)


def read_query(parameters: QueryParams) -> LiveQuery:
    """Read what is asked for; raise RequestValidationError where a part is unknown, out of bounds, or there twice."""
    given: dict[str, object] = {}
    for name, value in parameters.multi_items():
        given[name] = [*parameters.getlist(name)] if len(parameters.getlist(name)) > 1 else value
    try:
        return LiveQuery.model_validate(given)
    except ValidationError as error:
        found = [{**one, "loc": ("query", *one["loc"])} for one in error.errors(include_url=False)]
        raise RequestValidationError(found) from error


async def _refuse(websocket: WebSocket, error: RequestValidationError) -> None:
    """Answer with the problem instead of a socket; where the server cannot, with a close that names it."""
    problem = problem_of(error)
    if "websocket.http.response" in websocket.scope.get("extensions", {}):
        await websocket.send_denial_response(problem_response(problem))
        return
    reason = f"{problem.code}: {problem.detail}".encode()[:REASON_BYTES].decode(errors="ignore")
    await websocket.close(POLICY_VIOLATION, reason)
