"""Sessions: create, start, arm, watch, stop. Nothing here turns a beam on: arming lets the gate decide."""

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse

from engine.errors import (
    BeamLineError,
    CalibrationError,
    CommandRefusedError,
    ModelError,
    ModelMismatchError,
    RecordingError,
    RuntimeMissingError,
    SourceLostError,
)
from engine.permits import GateState, HoldReason
from engine.transition_journal import JournalError
from service import deps, schemas
from service.api import problems
from service.errors import (
    BoundError,
    EngineProcessError,
    EngineTimeoutError,
    MeshMissingError,
    NotFoundError,
    OperatorMismatchError,
    PictureMissingError,
    QaActiveError,
    QaOverdueError,
    SamplesRemovedError,
    ServiceStoppingError,
    SessionActiveError,
    SessionStateError,
    StartError,
    StorageLowError,
    StorageUnwritableError,
)
from service.gate_schemas import BaselineCorrectionRequest
from service.list_filters import SessionFilter, TransitionFilter
from service.ports import SampleFormat
from service.schema_base import Name

router = APIRouter(prefix="/sessions", tags=["sessions"])
READ = problems(NotFoundError)
ARROW, PARQUET = "application/vnd.apache.arrow.stream", "application/vnd.apache.parquet"
BINARY = {"schema": {"type": "string", "format": "binary"}}
SampleFormatQuery = Annotated[
    SampleFormat, Query(alias="format", description="Parquet is there once the session is closed")
]
CREATE = problems(
    NotFoundError,
    BoundError,
    OperatorMismatchError,
    RecordingError,
    SessionActiveError,
    QaActiveError,
    ModelMismatchError,
    CommandRefusedError,
    RuntimeMissingError,
    SourceLostError,
    StorageLowError,
    ServiceStoppingError,
    EngineProcessError,
)
START = problems(
    NotFoundError,
    BoundError,
    OperatorMismatchError,
    CalibrationError,
    RecordingError,
    StartError,
    SessionStateError,
    SessionActiveError,
    QaActiveError,
    ModelError,
    ModelMismatchError,
    CommandRefusedError,
    RuntimeMissingError,
    SourceLostError,
    BeamLineError,
    EngineProcessError,
    JournalError,
    StorageUnwritableError,
    ServiceStoppingError,
)
HOLD = problems(NotFoundError, SessionStateError, CommandRefusedError, EngineTimeoutError, BeamLineError)
ASK = problems(
    NotFoundError, OperatorMismatchError, SessionStateError, CommandRefusedError, EngineTimeoutError, BeamLineError
)
ARM = problems(
    NotFoundError,
    OperatorMismatchError,
    SessionStateError,
    CommandRefusedError,
    EngineTimeoutError,
    BeamLineError,
    QaOverdueError,
)


@router.post("", status_code=201, name="session.create", responses=CREATE)
def create_session(
    request: schemas.SessionRequest,
    caller: deps.Caller,
    services: deps.Offered,
    response: Response,
    idempotency_key: deps.IdempotencyKey = None,
) -> schemas.Session:
    """Create a session; one at a time may be created or running."""
    named = request.model_copy(update={"operator": caller.acts_as(request.operator)})
    kept = services.sessions.create(named, idempotency_key)
    if kept.is_replay:
        response.headers["Idempotency-Replayed"] = "true"
    return kept.answer


@router.get("")
def list_sessions(
    services: deps.Offered,
    pages: deps.Pages50,
    status: Annotated[schemas.SessionStatus | None, Query(description="Only those in this state")] = None,
    patient_reference: Annotated[Name | None, Query(description="Only those of this patient")] = None,
    plan_id: Annotated[Name | None, Query(description="Only those of this plan, by the id they were made with")] = None,
    since: deps.Since = None,
    until: deps.Until = None,
) -> schemas.SessionPage:
    """List sessions, newest first; since and until are of their creation."""
    wanted = SessionFilter(
        status=status, patient_reference=patient_reference, plan_id=plan_id, since=since, until=until
    )
    return pages.told(services.sessions.page(pages.cursor, pages.limit, wanted))


@router.get("/{session_id}", responses=READ)
def read_session(session_id: deps.SessionId, services: deps.Offered, fresh: deps.IfNoneMatch) -> schemas.SessionDetail:
    """Read a session with its gate, its learning and its figures.

    The ETag changes with every decision about the session, not with its figures: a running one is never 304.
    """
    etag = services.revisions.etag(session_id)  # before it is read: it may be older than what is told, never newer
    detail = services.sessions.detail(session_id)
    return fresh.told(detail, etag, may_be_left_out=detail.status != "running")


@router.post("/{session_id}/start", name="session.start", responses=START)
def start_session(
    session_id: deps.SessionId,
    request: schemas.OperatorRequest,
    caller: deps.Caller,
    services: deps.Offered,
    if_match: deps.IfMatch,
) -> schemas.Session:
    """Open the source and begin to learn, disarmed."""
    with services.revisions.only_if(session_id, if_match):
        return services.runner.start(session_id, caller.acts_as(request.operator))


@router.post("/{session_id}/arm", name="session.arm", responses=ARM)
def arm_session(
    session_id: deps.SessionId,
    request: schemas.OperatorRequest,
    caller: deps.Caller,
    services: deps.Offered,
    attendance: deps.Attending,
    if_match: deps.IfMatch,
) -> schemas.SessionDetail:
    """Let the gate decide from now on; refused without a model, a reference and a fresh frame."""
    operator = caller.acts_as(request.operator)
    with services.revisions.only_if(session_id, if_match):
        return services.runner.command(
            session_id, "arm", operator, may_be_done=lambda: attendance.answers_for(session_id, caller.identity)
        )


@router.post("/{session_id}/disarm", name="session.disarm", responses=HOLD)
async def disarm_session(
    session_id: deps.SessionId, operator: deps.Obeyed, services: deps.Offered, threads: deps.Undelayed
) -> schemas.SessionDetail:
    """Hold the beam until somebody arms again."""
    call = partial(services.runner.command, session_id, "disarm", operator)
    return await threads.run(call, takes=services.runner.is_running(session_id))


@router.post("/{session_id}/reference", name="session.reference", responses=ASK)
def set_reference(
    session_id: deps.SessionId,
    request: schemas.OperatorRequest,
    caller: deps.Caller,
    services: deps.Offered,
    if_match: deps.IfMatch,
) -> schemas.SessionDetail:
    """Make the patient's present position the zero of motion; disarms."""
    with services.revisions.only_if(session_id, if_match):
        return services.runner.command(session_id, "reference", caller.acts_as(request.operator))


@router.post("/{session_id}/acknowledge", name="session.acknowledge", responses=ASK)
def acknowledge_fault(
    session_id: deps.SessionId,
    request: schemas.OperatorRequest,
    caller: deps.Caller,
    services: deps.Offered,
    if_match: deps.IfMatch,
) -> schemas.SessionDetail:
    """Say that a person has seen the latched fault; the gate goes back to disarmed."""
    with services.revisions.only_if(session_id, if_match):
        return services.runner.command(session_id, "acknowledge", caller.acts_as(request.operator))


@router.post("/{session_id}/hold", name="session.hold", responses=HOLD)
async def hold_beam(
    session_id: deps.SessionId, operator: deps.Obeyed, services: deps.Offered, threads: deps.Undelayed
) -> schemas.SessionDetail:
    """Hold the beam until somebody releases it; the session stays armed. Never refused while it runs."""
    call = partial(services.runner.command, session_id, "hold", operator)
    return await threads.run(call, takes=services.runner.is_running(session_id))


@router.post("/{session_id}/release", name="session.release", responses=ASK)
def release_beam(
    session_id: deps.SessionId,
    request: schemas.OperatorRequest,
    caller: deps.Caller,
    services: deps.Offered,
    attendance: deps.Attending,
    if_match: deps.IfMatch,
) -> schemas.SessionDetail:
    """Let the gate decide again, after a full dwell; refused when nobody holds."""
    operator = caller.acts_as(request.operator)
    with services.revisions.only_if(session_id, if_match):
        return services.runner.command(
            session_id, "release", operator, may_be_done=lambda: attendance.answers_for(session_id, caller.identity)
        )


@router.post(
    "/{session_id}/presence",
    status_code=204,
    responses=problems(NotFoundError, OperatorMismatchError, SessionStateError),
)
def note_presence(
    session_id: deps.SessionId, request: schemas.OperatorRequest, caller: deps.Caller, services: deps.Offered
) -> None:
    """Say that the page of this person is still looked at; where the site asks for it, silence holds the beam."""
    services.runner.note_presence(session_id, caller.acts_as(request.operator))


@router.post("/{session_id}/baseline-correction", name="session.baseline_correction", responses=ASK)
def correct_baseline(
    session_id: deps.SessionId,
    request: BaselineCorrectionRequest,
    caller: deps.Caller,
    services: deps.Offered,
    if_match: deps.IfMatch,
) -> schemas.SessionDetail:
    """Move the window by a drift of the baseline that a person saw and confirms; disarms."""
    with services.revisions.only_if(session_id, if_match):
        return services.runner.correct_baseline(
            session_id, request.model_copy(update={"operator": caller.acts_as(request.operator)})
        )


@router.post("/{session_id}/stop", name="session.stop", responses=problems(NotFoundError, SessionStateError))
async def stop_session(
    session_id: deps.SessionId, operator: deps.Obeyed, services: deps.Offered, threads: deps.Undelayed
) -> schemas.Session:
    """Hold the beam, end the engine, close the session."""
    call = partial(services.runner.stop, session_id, operator)
    return await threads.run(call, takes=services.runner.is_running(session_id))


@router.get(
    "/{session_id}/samples",
    response_class=Response,
    responses={
        200: {
            "description": "One row a depth frame",
            "content": {"text/csv": {"schema": {"type": "string"}}, ARROW: BINARY, PARQUET: BINARY},
        },
        **problems(NotFoundError, SamplesRemovedError, SessionStateError),
    },
)
def export_samples(
    session_id: deps.SessionId, services: deps.Offered, caller: deps.Caller, form: SampleFormatQuery = "csv"
) -> StreamingResponse:
    """Export the samples, as far as they are written; what could not be measured is empty, never zero."""
    export = services.samples.export(session_id, form)
    services.audit.exported(actor=caller.name, action="samples.export", session_id=session_id, detail={"format": form})
    headers = {"Content-Disposition": f'attachment; filename="{export.file_name}"'}
    return StreamingResponse(export.pieces, media_type=export.media_type, headers=headers)


@router.get(
    "/{session_id}/picture",
    response_class=Response,
    responses={
        200: {"description": "The newest colour frame", "content": {"image/jpeg": BINARY}},
        **problems(NotFoundError, PictureMissingError),
    },
)
def read_picture(session_id: deps.SessionId, services: deps.Offered) -> Response:
    """Show the newest colour frame; `X-Frame-Index` tells which."""
    picture = services.runner.picture(session_id)
    headers = {"X-Frame-Index": str(picture.frame_index), "Cache-Control": "no-store"}
    return Response(picture.jpeg, media_type="image/jpeg", headers=headers)


@router.get("/{session_id}/mesh", responses=problems(NotFoundError, MeshMissingError))
def read_mesh(session_id: deps.SessionId, services: deps.Offered) -> schemas.SurfaceMesh:
    """Show the surface of the newest frame as a mesh in the depth camera's frame."""
    return services.runner.mesh(session_id)


@router.get("/{session_id}/transitions", responses=READ)
def list_transitions(
    session_id: deps.SessionId,
    services: deps.Offered,
    pages: deps.Pages200,
    to_state: Annotated[GateState | None, Query(description="Only those into this state")] = None,
    reason: Annotated[HoldReason | None, Query(description="Only those for this reason, see /interlocks")] = None,
) -> schemas.TransitionPage:
    """List the gate's transitions, oldest first."""
    wanted = TransitionFilter(
        to_state=None if to_state is None else to_state.value, reason=None if reason is None else reason.value
    )
    return pages.told(services.sessions.transitions(session_id, pages.cursor, pages.limit, wanted))
