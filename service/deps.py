"""What routers are given: the ports, found on the application, and the parameters they share."""

import re
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, TypeVar, cast

import anyio
from fastapi import Depends, Header, Path, Query, Request, Response
from pydantic import AwareDatetime
from starlette.requests import ClientDisconnect, HTTPConnection

from service import ports
from service.access import behalf
from service.access.attendance import Attendance
from service.access.calling import Calling
from service.access.claims import Claim, read_claim
from service.access.desk import AccessDesk
from service.access.guard import ADDRESS
from service.access.identity import RULE, identity_in
from service.conditional import LONGEST, Precondition, is_known, precondition
from service.errors import MediaTypeError, NotLoggedInError
from service.idempotency import CallersKey
from service.middleware import RefusedError
from service.own_threads import OwnThreads
from service.paging import LONGEST as LONGEST_CURSOR
from service.paging import Paging
from service.qa.ports import QaBookPort, QaDeskPort
from service.schema_base import Identifier, Name
from service.strictness import takes_beam_away

AnswerT = TypeVar("AnswerT")
PARAMETER = re.compile(r"\{(\w+)\}")


@dataclass(frozen=True, slots=True, kw_only=True)
class Services:
    """Everything the application offers."""

    sessions: ports.SessionsPort
    runner: ports.RunnerPort
    samples: ports.SamplesPort
    calibrations: ports.CalibrationsPort
    models: ports.ModelsPort
    plans: ports.PlansPort
    planned_sessions: ports.PlannedSessionsPort
    audit: ports.AuditPort
    health: ports.HealthPort
    interlocks: ports.InterlocksPort
    metrics: ports.MetricsPort
    engine: ports.EnginePort
    qa_desk: QaDeskPort
    qa_book: QaBookPort
    revisions: ports.RevisionsPort


def services(connection: HTTPConnection) -> Services:
    """Find the services on the application; they are made in the lifespan."""
    return cast("Services", connection.app.state.services)


def access(connection: HTTPConnection) -> AccessDesk:
    """Find who may do what on the application; made in the lifespan."""
    return cast("AccessDesk", connection.app.state.access)


async def attendance(connection: HTTPConnection) -> Attendance:
    """Find who looks whether whoever armed is still there."""
    return cast("Attendance", connection.app.state.attendance)


def caller(connection: HTTPConnection) -> Calling:
    """Return who calls; the guard has seen to it."""
    identity = identity_in(connection.scope)
    if identity is None:
        raise NotLoggedInError
    return Calling(identity=identity)


async def sender_address(connection: HTTPConnection) -> str:
    """Return where the request comes from, as the guard found it."""
    return str(connection.scope[ADDRESS])


def require_guarded(connection: HTTPConnection) -> None:
    """Fail a call that reached another route than the one whose rule let it in.

    The whole template is nowhere to be had for a route of an included router: its end, its parameters, and the path
    that it makes with them are.
    """
    method, template = connection.scope.get(RULE, (None, ""))
    parameters = connection.scope["path_params"]
    is_same = (
        method == connection.scope.get("method", "WEBSOCKET")
        and template.endswith(getattr(connection.scope.get("route"), "path_format", ""))
        and set(PARAMETER.findall(template)) == parameters.keys()
        and template.format(**parameters) == connection.scope["path"]
    )
    if not is_same:
        msg = f"the guard let {method} {template} in, and it came to another route"
        raise RuntimeError(msg)


async def guarded(connection: HTTPConnection) -> None:
    """Do as :func:`require_guarded`, on the event loop: no request waits for a worker thread because of it."""
    require_guarded(connection)


async def json_body(request: Request) -> bytes:
    """Read the raw body, as far as the body limit lets it."""
    return await request.body()


CALIBRATION_MEDIA = ("application/json", "application/yaml", "application/xml")
"""What a calibration may be uploaded as; no form of a foreign page can post any of them."""
MEDIA_OF = {"calibration.upload": CALIBRATION_MEDIA, "plan.import": ("application/dicom",)}


async def require_json(request: Request) -> None:
    """Refuse a body that is not JSON by its Content-Type: a form of a foreign page could post it otherwise.

    What takes permission away is done whatever its type; the guard has refused foreign pages by their Origin.
    """
    if request.method not in {"POST", "PUT", "PATCH"} or takes_beam_away(request):
        return
    allowed = MEDIA_OF.get(getattr(request.scope.get("route"), "name", ""), ("application/json",))
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type not in allowed:
        bound = " or ".join(allowed)
        msg = f"Content-Type must be {bound}"
        raise MediaTypeError(msg, field="Content-Type", value=media_type, bound=bound)


async def plan_file(request: Request) -> AsyncIterator[bytes]:
    """Read a plan's file, once there is a place for one in memory; the place is free again after the answer."""
    with services(request).plans.taking_one():
        yield await request.body()


# On the event loop: no request waits for a worker thread, of which hold and stop need one, because of these.
async def _offered(connection: HTTPConnection) -> Services:
    return services(connection)


async def _access(connection: HTTPConnection) -> AccessDesk:
    return access(connection)


async def _own_threads(connection: HTTPConnection) -> OwnThreads:
    return cast("OwnThreads", connection.app.state.own_threads)


async def _calling(connection: HTTPConnection) -> Calling:
    return caller(connection)


A_MOMENT_S = 0.25
"""How long the body of a call that takes permission away is waited for: it tells for whom a machine acts, no more."""
NOT_WHOLE = "it did not come whole"


async def _obeyed(request: Request, caller: Annotated[Calling, Depends(_calling)]) -> str:
    """Return in whose name permission is taken away, whatever the body says, and whether or not it comes.

    A person's name is the log-in's: that body is not even read.
    """
    if caller.identity.is_person:
        return caller.name
    claim = await _claim(request)
    if claim.unread is not None:
        behalf.leave_unread(claim.unread)
    return caller.whatever_is_claimed(claim.operator)


async def _claim(request: Request) -> Claim:
    """Read for whom a machine acts, where that is said at once, in a body that any other call could have."""
    with suppress(ClientDisconnect, RefusedError), anyio.move_on_after(A_MOMENT_S):
        return read_claim(await request.body())
    return Claim(unread=NOT_WHOLE)


Offered = Annotated[Services, Depends(_offered)]
Access = Annotated[AccessDesk, Depends(_access)]
Caller = Annotated[Calling, Depends(_calling)]
Obeyed = Annotated[str, Depends(_obeyed)]
Undelayed = Annotated[OwnThreads, Depends(_own_threads)]
Attending = Annotated[Attendance, Depends(attendance)]
Address = Annotated[str, Depends(sender_address)]
Body = Annotated[bytes, Depends(json_body)]
PlanFile = Annotated[bytes, Depends(plan_file)]
SessionId = Annotated[Identifier, Path(description="The session's id")]
CalibrationId = Annotated[Identifier, Path(description="The calibration's id")]
PlanId = Annotated[Identifier, Path(description="The plan's id")]
ModelId = Annotated[Identifier, Path(description="The model's id")]
Cursor = Annotated[str | None, Query(max_length=LONGEST_CURSOR, description="`next_cursor` of the page before")]
Limit = Annotated[int, Query(ge=1, le=500, description="Most items on the page")]
Since = Annotated[AwareDatetime | None, Query(description="From this time on")]
Until = Annotated[AwareDatetime | None, Query(description="Before this time")]


def _paged(usual: int) -> Callable[..., Awaitable[Paging]]:
    async def paged(request: Request, response: Response, cursor: Cursor = None, limit: Limit = usual) -> Paging:
        return Paging(request, response, cursor, limit)

    return paged


Pages50 = Annotated[Paging, Depends(_paged(50))]
Pages100 = Annotated[Paging, Depends(_paged(100))]
Pages200 = Annotated[Paging, Depends(_paged(200))]
OperatorName = Annotated[
    Name,
    Query(
        description="Who uploads: whoever is logged in, and may be left out; from a machine, for whom it acts",
        examples=["A. Physicist"],
    ),
]


async def callers_key(
    caller: Caller,
    idempotency_key: Annotated[
        str | None,
        Header(
            min_length=1,
            max_length=255,
            pattern=r"^[\x21-\x7e]+$",
            description="The same key of the same caller with the same body gives the same answer, for 7 days unless "
            "the site says otherwise; nothing is done twice",
            examples=["6b1f0d3c-1c54-4f0e-9c5e-3f6f1b8a2d11"],
        ),
    ] = None,
) -> CallersKey | None:
    """Return the Idempotency-Key as whoever calls owns it."""
    if idempotency_key is None:
        return None
    return CallersKey(caller=f"{caller.identity.kind}:{caller.name}", key=idempotency_key)


async def if_match(
    if_match: Annotated[
        str | None,
        Header(
            max_length=LONGEST,
            description="Do it only where the ETag is still this one; 412 `precondition_failed` otherwise",
        ),
    ] = None,
) -> Precondition:
    """Return what has to be so for this to be done."""
    return precondition(if_match)


class Freshness:
    """What the client has already, and the answer that it may not need again."""

    def __init__(
        self,
        response: Response,
        if_none_match: str | None,
    ) -> None:
        self._response = response
        self._if_none_match = if_none_match

    def told(self, answer: AnswerT, etag: str, *, may_be_left_out: bool = True) -> AnswerT:
        """Return the answer with its ETag; or 304 without one, which FastAPI passes on as it is."""
        if may_be_left_out and is_known(self._if_none_match, etag):
            return cast("AnswerT", Response(status_code=304, headers={"ETag": etag}))
        self._response.headers["ETag"] = etag
        return answer


async def freshness(
    response: Response,
    if_none_match: Annotated[
        str | None, Header(max_length=LONGEST, description="Answer 304 where the ETag is still this one")
    ] = None,
) -> Freshness:
    """Return what the client has already."""
    return Freshness(response, if_none_match)


IdempotencyKey = Annotated[CallersKey | None, Depends(callers_key)]
IfMatch = Annotated[Precondition, Depends(if_match)]
IfNoneMatch = Annotated[Freshness, Depends(freshness)]
