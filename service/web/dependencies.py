"""What routers receive: the services, found on the application, and the parameters that several calls share."""

import re
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Annotated, TypeVar, cast

import anyio
from fastapi import Depends, Header, Path, Query, Request, Response
from pydantic import AwareDatetime, BaseModel
from starlette.requests import ClientDisconnect, HTTPConnection

from service.access.request.identity import RULE, ClaimedOperator, RequestCaller, identity_in, read_claim
from service.access.service import AccessService
from service.core.conditional import LONGEST, Precondition, is_known, precondition
from service.core.errors import MediaTypeError, NotLoggedInError
from service.core.schemas.base import Identifier, Name
from service.engine_host.protocols import EnginePort
from service.exchange.outbox import Outbox
from service.monitoring.machine import MachineDescription
from service.monitoring.metrics.registry import Metrics
from service.monitoring.readiness import ReadinessProbe
from service.planning.rt_plan.planned_sessions import PlannedSessions
from service.planning.rt_plan.repository import PlanRepository
from service.qa.archive import QaArchive
from service.qa.runs import QaRunService
from service.sessions.alarms.board import AlarmBoard
from service.sessions.coaching.board import CoachingBoard
from service.sessions.lifecycle.runner import SessionRunner
from service.sessions.records.arming import ArmingSummaries
from service.sessions.records.calibrations import CalibrationRepository, ModelRepository, RecordingList
from service.sessions.records.etags import SessionRevisions
from service.sessions.records.sessions import SessionRepository
from service.sessions.report.exports import SessionExports
from service.sessions.report.reports import ReportService
from service.sessions.report.simulations import SimulationDays
from service.sessions.report.trace import SessionTraces
from service.sessions.views.interlocks import InterlockTable
from service.storage.audit import chain
from service.storage.audit.service import AuditService
from service.storage.database.idempotency import CallersKey, IdempotentAnswer
from service.storage.samples.service import SampleService
from service.web.middleware.guard import ADDRESS
from service.web.middleware.requests import RefusedError, takes_beam_away
from service.web.middleware.reserved_threads import ReservedThreads
from service.web.paging import LONGEST as LONGEST_CURSOR, Paging

AnswerT = TypeVar("AnswerT", bound=BaseModel)
PARAMETER = re.compile(r"\{(\w+)\}")
CALIBRATION_MEDIA = ("application/json", "application/yaml", "application/xml")
"""Media types of an uploaded calibration; a form of another origin can send none of them."""
MEDIA_OF = {"calibration.upload": CALIBRATION_MEDIA, "plan.import": ("application/dicom", "application/octet-stream")}
BODY_WAIT_S = 0.25
"""How long a call that takes permission away waits for its body, which only names whom a machine acts for [s]."""
NOT_WHOLE = "it did not come whole"
SessionId = Annotated[Identifier, Path(description="The session's id")]
CalibrationId = Annotated[Identifier, Path(description="The calibration's id")]
PlanId = Annotated[Identifier, Path(description="The plan's id")]
ModelId = Annotated[Identifier, Path(description="The model's id")]
Cursor = Annotated[str | None, Query(max_length=LONGEST_CURSOR, description="`next_cursor` of the page before")]
Limit = Annotated[int, Query(ge=1, le=500, description="Most items on the page")]
Since = Annotated[AwareDatetime | None, Query(description="From this time on")]
Until = Annotated[AwareDatetime | None, Query(description="Before this time")]
OperatorName = Annotated[
    Name | None,
    Query(
        description="The person who uploads: optional for a logged-in person; for a machine, the person it acts for",
        examples=["A. Physicist"],
    ),
]


@dataclass(frozen=True, slots=True, kw_only=True)
class Services:
    """The services that routers call; made by the container."""

    sessions: SessionRepository
    runner: SessionRunner
    arming: ArmingSummaries
    samples: SampleService
    reports: ReportService
    exports: SessionExports
    simulations: SimulationDays
    outbox: Outbox
    traces: SessionTraces
    calibrations: CalibrationRepository
    recordings: RecordingList
    models: ModelRepository
    plans: PlanRepository
    planned_sessions: PlannedSessions
    audit: AuditService
    health: ReadinessProbe
    machine: MachineDescription
    interlocks: InterlockTable
    metrics: Metrics
    engine: EnginePort
    qa_runs: QaRunService
    qa_archive: QaArchive
    revisions: SessionRevisions
    alarms: AlarmBoard
    coaching: CoachingBoard


def services(connection: HTTPConnection) -> Services:
    """Find the services on the application; they are made in the lifespan."""
    return cast("Services", connection.app.state.services)


def access(connection: HTTPConnection) -> AccessService:
    """Find the access service on the application; made in the lifespan."""
    return cast("AccessService", connection.app.state.access)


def caller(connection: HTTPConnection) -> RequestCaller:
    """Return the authenticated caller, as the guard found it; raise NotLoggedInError without one."""
    identity = identity_in(connection.scope)
    if identity is None:
        raise NotLoggedInError
    return RequestCaller(identity=identity)


async def sender_address(connection: HTTPConnection) -> str:
    """Return the client's address, as the guard found it."""
    return str(connection.scope[ADDRESS])


def require_guarded(connection: HTTPConnection) -> None:
    """Raise RuntimeError for a call that reached another route than the one whose access rule was checked.

    The full template of a route in an included router is not available; the comparison uses its end, its parameters,
    and the path that the rule's template makes with them.
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
        msg = f"the guard checked {method} {template}, but the call reached another route"
        raise RuntimeError(msg)


async def guarded(connection: HTTPConnection) -> None:
    """Call :func:`require_guarded` on the event loop, so that it takes no worker thread."""
    require_guarded(connection)


async def json_body(request: Request) -> bytes:
    """Read the raw body, up to the body limit."""
    return await request.body()


async def require_json(request: Request) -> None:
    """Refuse a body whose Content-Type is not JSON: a form of another origin could send it otherwise.

    A call that takes permission away is accepted with any type; the guard has refused other origins already.
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
    """Read an RT Plan file, within the limit of files in memory at a time; raise PlanBusyError beyond it."""
    with services(request).plans.upload_slot():
        yield await request.body()


# Async, so that they run on the event loop: worker threads stay free for routes.
async def _services(connection: HTTPConnection) -> Services:
    return services(connection)


async def _access(connection: HTTPConnection) -> AccessService:
    return access(connection)


async def _withdrawal_threads(connection: HTTPConnection) -> ReservedThreads:
    return cast("ReservedThreads", connection.app.state.own_threads)


async def _calling(connection: HTTPConnection) -> RequestCaller:
    return caller(connection)


async def _withdrawing_operator(request: Request, caller: Annotated[RequestCaller, Depends(_calling)]) -> str:
    """Return the operator of a call that takes permission away, without refusing any body or waiting for it.

    A person is identified by the login, so that body is not read.
    """
    if caller.identity.is_person:
        return caller.name
    claim = await _claim(request)
    if claim.unread is not None:
        chain.leave_unread(claim.unread)
    return caller.actor_unchecked(claim.operator)


async def _claim(request: Request) -> ClaimedOperator:
    """Read whom a machine acts for, if a valid body with that name arrives at once."""
    with suppress(ClientDisconnect, RefusedError), anyio.move_on_after(BODY_WAIT_S):
        return read_claim(await request.body())
    return ClaimedOperator(unread=NOT_WHOLE)


AppServices = Annotated[Services, Depends(_services)]
Access = Annotated[AccessService, Depends(_access)]
Caller = Annotated[RequestCaller, Depends(_calling)]
WithdrawingOperator = Annotated[str, Depends(_withdrawing_operator)]
WithdrawalThreads = Annotated[ReservedThreads, Depends(_withdrawal_threads)]
Address = Annotated[str, Depends(sender_address)]
Body = Annotated[bytes, Depends(json_body)]
PlanFile = Annotated[bytes, Depends(plan_file)]


def _paged(usual: int) -> Callable[..., Awaitable[Paging]]:
    async def paged(request: Request, response: Response, cursor: Cursor = None, limit: Limit = usual) -> Paging:
        return Paging(request, response, cursor, limit)

    return paged


Pages50 = Annotated[Paging, Depends(_paged(50))]
Pages100 = Annotated[Paging, Depends(_paged(100))]
Pages200 = Annotated[Paging, Depends(_paged(200))]


async def callers_key(
    caller: Caller,
    idempotency_key: Annotated[
        str | None,
        Header(
            min_length=1,
            max_length=255,
            pattern=r"^[\x21-\x7e]+$",
            description="A repeated request of one caller with this key and the same body gets the first answer and "
            "has no second effect; kept for 7 days unless the site sets another time",
            examples=["6b1f0d3c-1c54-4f0e-9c5e-3f6f1b8a2d11"],
        ),
    ] = None,
) -> CallersKey | None:
    """Return the Idempotency-Key together with its caller; None without one."""
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
    """Return the condition under which the call is executed."""
    return precondition(if_match)


class Freshness:
    """Answers 304 where the client already has the present version of a resource."""

    def __init__(
        self,
        response: Response,
        if_none_match: str | None,
    ) -> None:
        self._response = response
        self._if_none_match = if_none_match

    def answer(self, answer: AnswerT, etag: str, *, may_be_304: bool = True) -> AnswerT:
        """Return the answer and set its ETag; return a 304 response instead where the client has this version."""
        if may_be_304 and is_known(self._if_none_match, etag):
            return cast("AnswerT", Response(status_code=304, headers={"ETag": etag}))
        self._response.headers["ETag"] = etag
        return answer


async def freshness(
    response: Response,
    if_none_match: Annotated[
        str | None, Header(max_length=LONGEST, description="Answer 304 where the ETag is still this one")
    ] = None,
) -> Freshness:
    """Return the check against the client's ``If-None-Match``."""
    return Freshness(response, if_none_match)


def created(made: IdempotentAnswer[AnswerT], response: Response) -> AnswerT:
    """Return the answer of a creating call; mark one that repeats the answer to an earlier request."""
    if made.is_replay:
        response.headers["Idempotency-Replayed"] = "true"
    return made.answer


IdempotencyKey = Annotated[CallersKey | None, Depends(callers_key)]
IfMatch = Annotated[Precondition, Depends(if_match)]
IfNoneMatch = Annotated[Freshness, Depends(freshness)]
