"""Routes of sessions. No call switches the beam on: arming allows the gate to do so."""

from dataclasses import asdict
from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.responses import StreamingResponse

from engine.core.gate_state import GateState, HoldReason
from service.access.login.logins import Attempt
from service.core.list_filters import SessionFilter, TransitionFilter
from service.core.permissions import Permission
from service.core.schemas import sessions
from service.core.schemas.base import Name
from service.core.schemas.gate import ArmingSummary, BaselineCorrectionRequest
from service.core.schemas.reports import (
    NoteRequest,
    SendRequest,
    SentSession,
    SessionMoment,
    SessionReport,
    SessionTrace,
    SignatureRequest,
)
from service.core.schemas.simulations import Simulation, SimulationRequest
from service.sessions.report.pages import report_html, report_pdf
from service.storage.samples.service import SampleFormat
from service.web import dependencies
from service.web.operator_calls import Operated, Withdrawing

router = APIRouter(prefix="/sessions", tags=["sessions"])
DICOM = "application/dicom"
ARROW, PARQUET = "application/vnd.apache.arrow.stream", "application/vnd.apache.parquet"
BINARY = {"schema": {"type": "string", "format": "binary"}}
SampleFormatQuery = Annotated[
    SampleFormat, Query(alias="format", description="`parquet` is available after the session is closed")
]
LONGEST_S = 200_000.0
TraceFrom = Annotated[float, Query(ge=0.0, le=LONGEST_S, allow_inf_nan=False, description="Since the first frame [s]")]
TraceTo = Annotated[float, Query(gt=0.0, le=LONGEST_S, allow_inf_nan=False, description="After `from_s` [s]")]
TracePoints = Annotated[
    int, Query(ge=10, le=5000, description="Ranges at most; fewer samples are returned as they are")
]


@router.post("", status_code=201, name="session.create")
def create_session(
    request: sessions.SessionRequest,
    caller: dependencies.Caller,
    services: dependencies.AppServices,
    response: Response,
    idempotency_key: dependencies.IdempotencyKey = None,
) -> sessions.Session:
    """Create a session; only one session at a time may be created or running."""
    named = request.model_copy(update={"operator": caller.checked_actor(request.operator)})
    return dependencies.created(services.sessions.create(named, idempotency_key), response)


@router.get("")
def list_sessions(
    services: dependencies.AppServices,
    pages: dependencies.Pages50,
    status: Annotated[sessions.SessionStatus | None, Query(description="Only sessions with this status")] = None,
    patient_reference: Annotated[Name | None, Query(description="Only sessions of this patient")] = None,
    plan_id: Annotated[
        Name | None, Query(description="Only sessions of this plan, by the plan id they were created with")
    ] = None,
    search: Annotated[
        Name | None,
        Query(description="Only sessions with this in the patient's reference, the plan's or fraction's id"),
    ] = None,
    since: dependencies.Since = None,
    until: dependencies.Until = None,
) -> sessions.SessionPage:
    """List sessions, newest first; `since` and `until` refer to the time of creation."""
    wanted = SessionFilter(
        status=status, patient_reference=patient_reference, plan_id=plan_id, search=search, since=since, until=until
    )
    return pages.answer(services.sessions.page(pages.cursor, pages.limit, wanted))


@router.get("/{session_id}")
def read_session(
    session_id: dependencies.SessionId, services: dependencies.AppServices, fresh: dependencies.IfNoneMatch
) -> sessions.SessionDetail:
    """Read a session with gate, training and statistics.

    The ETag covers what callers change, not the statistics; a running session is therefore never answered with 304.
    """
    etag = services.revisions.etag(
        session_id
    )  # before the session is read: it may be older than the answer, never newer
    detail = services.sessions.detail(session_id)
    return fresh.answer(detail, etag, may_be_304=detail.status != "running")


@router.post("/{session_id}/simulation", name="session.simulation")
def sign_simulation(
    session_id: dependencies.SessionId,
    request: SimulationRequest,
    services: dependencies.AppServices,
    caller: dependencies.Caller,
    desk: dependencies.Access,
    address: dependencies.Address,
) -> Simulation:
    """Sign what the plan was made on: a session or a file of the simulation day, of the same patient; for people only.

    The session must not be started: a session's confirmed reference becomes the plan's position then.
    """
    actor = caller.checked_actor(request.operator)
    password = None if request.password is None else request.password.get_secret_value()
    confirmed_by = desk.confirm_signer(caller.identity, password, address)
    return services.simulations.sign(session_id, request, actor, confirmed_by=confirmed_by)


@router.get("/{session_id}/simulation")
def read_simulation(session_id: dependencies.SessionId, services: dependencies.AppServices) -> Simulation:
    """Return the simulation day of the session's plan, as it was signed last: breath, window in per cent, trace."""
    return services.simulations.of(session_id)


@router.post("/{session_id}/start", name="session.start")
def start_session(
    session_id: dependencies.SessionId, request: sessions.OperatorRequest, call: Operated
) -> sessions.Session:
    """Start the session: open the source and train the motion model, disarmed."""
    with call.acting(session_id, request.operator) as operator:
        return call.services.runner.start(session_id, operator)


@router.post("/{session_id}/arm", name="session.arm")
def arm_session(
    session_id: dependencies.SessionId, request: sessions.ArmRequest, call: Operated
) -> sessions.SessionDetail:
    """Arm the gate; refused without a motion model, a reference and a fresh frame.

    If the window is on a part of the patient, `head_direction` confirms on which side of the picture the head lies.
    """
    return call.arm(session_id, request)


@router.get("/{session_id}/arming")
def read_arming(
    session_id: dependencies.SessionId, services: dependencies.AppServices, fresh: dependencies.IfNoneMatch
) -> ArmingSummary:
    """Return what the gate would be armed with, and what is missing; for the person who arms.

    Its ETag is the session's: with `If-Match`, arming is refused if anything was decided since.
    """
    etag = services.revisions.etag(session_id)  # before the session is read
    return fresh.answer(services.arming.of(session_id), etag, may_be_304=False)


@router.post("/{session_id}/disarm", name="session.disarm")
async def disarm_session(session_id: dependencies.SessionId, call: Withdrawing) -> sessions.SessionDetail:
    """Disarm the gate: hold the beam until a person arms again."""
    return await call.command(session_id, "disarm")


@router.post("/{session_id}/reference", name="session.reference")
def set_reference(
    session_id: dependencies.SessionId, request: sessions.ReferenceRequest, call: Operated
) -> sessions.SessionDetail:
    """Set the reference: the position at the last ends of exhale becomes zero motion; disarms. For people only.

    Far from the fraction's first reference it needs a reason, and the permission `gate.arm`.
    """
    with call.acting(session_id, request.operator) as operator:
        return call.commands.set_reference(session_id, operator, request=request, may_exceed=call.may_exceed)


@router.post("/{session_id}/position-check", name="session.position_check")
def sign_position(
    session_id: dependencies.SessionId, request: sessions.PositionCheckRequest, call: Operated
) -> sessions.SessionDetail:
    """Sign the patient's position against that of the plan's first fraction; arming needs it. For people only.

    Beyond the tolerance, and where the surface does not determine it, it needs a reason and the permission `gate.arm`.
    """
    with call.acting(session_id, request.operator) as operator:
        return call.commands.sign_position(session_id, operator, request=request, may_exceed=call.may_exceed)


@router.post("/{session_id}/countersign", name="session.countersign")
def countersign(
    session_id: dependencies.SessionId,
    request: sessions.CountersignRequest,
    call: Operated,
    desk: dependencies.Access,
    address: dependencies.Address,
) -> sessions.SessionDetail:
    """Countersign the reference and the window, as a second person, before a fraction's first arming. For people only.

    With name and password, the second person signs where another person is logged in; no log-in stays open.
    """
    signer = None
    if request.name is not None and request.password is not None:
        attempt = Attempt(name=request.name, password=request.password.get_secret_value(), address=address)
        signer = desk.second_person(attempt, Permission.GATE_REFERENCE)
    with call.acting(session_id, request.operator) as operator:
        return call.commands.countersign(session_id, operator, state=request.state, signer=signer)


@router.post("/{session_id}/acknowledge", name="session.acknowledge")
def acknowledge_fault(
    session_id: dependencies.SessionId, request: sessions.AcknowledgeRequest, call: Operated
) -> sessions.SessionDetail:
    """Acknowledge the latched fault, after which the gate is disarmed, and active alarms. For people only.

    An acknowledged alarm that does not latch stays active until its cause is gone.
    """
    with call.acting(session_id, request.operator) as operator:
        return call.commands.acknowledge(session_id, operator, alarms=request.alarms)


@router.post("/{session_id}/hold", name="session.hold")
async def hold_beam(session_id: dependencies.SessionId, call: Withdrawing) -> sessions.SessionDetail:
    """Hold the beam until it is released; the gate stays armed. Never refused while the session runs.

    A person's hold is released by a person; a program's by itself, or by a person.
    """
    return await call.command(session_id, "hold")


@router.post("/{session_id}/release", name="session.release")
def release_beam(
    session_id: dependencies.SessionId, request: sessions.OperatorRequest, call: Operated
) -> sessions.SessionDetail:
    """Release the caller's own hold; the beam needs a full dwell, and stays held while another operator holds.

    A person without a hold releases those of all others. Refused to a program without a hold, and where nobody holds.
    """
    with call.acting(session_id, request.operator) as operator:
        return call.commands.release(session_id, operator, is_person=call.caller.identity.is_person)


@router.post(
    "/{session_id}/presence",
    status_code=204,
)
def note_presence(
    session_id: dependencies.SessionId,
    request: sessions.OperatorRequest,
    caller: dependencies.Caller,
    services: dependencies.AppServices,
) -> None:
    """Report that a person who may arm is at the page: call it every second while the page is visible, for people only.

    While the gate is armed, `TIDEGATE_OPERATOR_TIMEOUT_S` without a report of the person who armed (of any person,
    where a program armed) holds the beam. A program can arm only while a person reports.
    """
    services.runner.commands.note_presence(session_id, caller.checked_actor(request.operator))


@router.post("/{session_id}/baseline-correction", name="session.baseline_correction")
def correct_baseline(
    session_id: dependencies.SessionId, request: BaselineCorrectionRequest, call: Operated
) -> sessions.SessionDetail:
    """Shift the window by a baseline drift that a person confirms; disarms.

    Far from the fraction's first reference it needs a person, and a reason.
    """
    with call.acting(session_id, request.operator) as operator:
        return call.commands.correct_baseline(session_id, operator, request=request, may_exceed=call.may_exceed)


@router.post(
    "/{session_id}/window",
    name="session.window",
)
def set_window(
    session_id: dependencies.SessionId, request: sessions.WindowRequest, call: Operated
) -> sessions.SessionDetail:
    """Set the window of a running session, once its breathing is known; refused while the gate is armed.

    Signals and kinds of conditions stay those of the session. A baseline correction ends with it. Far beyond the
    fraction's first armed window it needs a person who may arm, and a reason.
    """
    with call.acting(session_id, request.operator) as operator:
        return call.commands.set_window(session_id, operator, request=request, may_exceed=call.may_exceed)


@router.post("/{session_id}/stop", name="session.stop")
async def stop_session(session_id: dependencies.SessionId, call: Withdrawing) -> sessions.Session:
    """Stop the session: hold the beam, end the engine, close the records."""
    return await call.act(session_id, call.runner.stop)


@router.get(
    "/{session_id}/samples",
    response_class=Response,
    responses={
        200: {
            "description": "One row per depth frame",
            "content": {"text/csv": {"schema": {"type": "string"}}, ARROW: BINARY, PARQUET: BINARY},
        },
    },
)
def export_samples(
    session_id: dependencies.SessionId,
    services: dependencies.AppServices,
    caller: dependencies.Caller,
    form: SampleFormatQuery = "csv",
) -> StreamingResponse:
    """Export the samples written so far; unmeasured values are empty, never zero."""
    export = services.samples.export(session_id, form)
    services.audit.exported(actor=caller.name, action="samples.export", session_id=session_id, detail={"format": form})
    headers = {"Content-Disposition": f'attachment; filename="{export.file_name}"'}
    return StreamingResponse(export.pieces, media_type=export.media_type, headers=headers)


@router.get("/{session_id}/trace")
def read_trace(
    session_id: dependencies.SessionId,
    services: dependencies.AppServices,
    from_s: TraceFrom = 0.0,
    to_s: TraceTo = LONGEST_S,
    points: TracePoints = 1000,
) -> SessionTrace:
    """Return a part of the trace of a session that is over: least and most of each signal, beam on and holds."""
    return services.traces.part(session_id, from_s, to_s, points)


@router.get("/{session_id}/moment")
def read_moment(
    session_id: dependencies.SessionId, services: dependencies.AppServices, at_s: TraceFrom = 0.0
) -> SessionMoment:
    """Return the sample of a session that is over which is nearest to a time, with the breathing surface."""
    return services.traces.moment(session_id, at_s)


@router.get("/{session_id}/report")
def read_report(session_id: dependencies.SessionId, services: dependencies.AppServices) -> SessionReport:
    """Return the report of a session that is over: figures of its samples, events of the audit, versions."""
    return services.reports.of(session_id).report


@router.post("/{session_id}/note", name="session.note")
def add_note(
    session_id: dependencies.SessionId,
    request: NoteRequest,
    services: dependencies.AppServices,
    caller: dependencies.Caller,
) -> SessionReport:
    """Add a note to the report of a session that is over; it signs nothing. For people only."""
    return services.reports.add_note(session_id, request, caller.checked_actor(request.operator))


@router.post("/{session_id}/signature", name="session.signature")
def sign_report(
    session_id: dependencies.SessionId,
    request: SignatureRequest,
    services: dependencies.AppServices,
    caller: dependencies.Caller,
    desk: dependencies.Access,
    address: dependencies.Address,
) -> SessionReport:
    """Sign the report of a session that is over, with one's own password and what the signature means; for people only.

    A signature is of the report as it was read: with other samples it is refused, and each person signs once.
    """
    actor = caller.checked_actor(request.operator)
    password = None if request.password is None else request.password.get_secret_value()
    confirmed_by = desk.confirm_signer(caller.identity, password, address)
    signed = services.reports.sign(session_id, request, actor, confirmed_by=confirmed_by)
    count = sum(one.is_signed and one.is_of_this for one in signed.signatures)
    if services.outbox.takes_signed and count >= signed.signatures_needed:
        services.outbox.ask(session_id, actor)
    return signed


@router.post("/{session_id}/send", name="session.send")
def send_session(
    session_id: dependencies.SessionId,
    request: SendRequest,
    services: dependencies.AppServices,
    caller: dependencies.Caller,
) -> SentSession:
    """Send curve and report of a session that is over to the PACS; it is tried until the PACS has taken both.

    For people only; the same session again is sent again.
    """
    actor = caller.checked_actor(request.operator)
    services.reports.accept(session_id, request, actor, services.outbox.pacs)
    return SentSession.model_validate(asdict(services.outbox.ask(session_id, actor)))


@router.get(
    "/{session_id}/report.pdf",
    response_class=Response,
    responses={200: {"description": "The report", "content": {"application/pdf": BINARY}}},
)
def export_report_pdf(
    session_id: dependencies.SessionId, services: dependencies.AppServices, caller: dependencies.Caller
) -> Response:
    """Return the report as a PDF to be signed; the same bytes for the same session."""
    body = report_pdf(services.reports.of(session_id))
    return _exported(session_id, services, caller, body, "pdf", "application/pdf")


@router.get(
    "/{session_id}/report.html",
    response_class=Response,
    responses={200: {"description": "The report", "content": {"text/html": {"schema": {"type": "string"}}}}},
)
def export_report_html(
    session_id: dependencies.SessionId, services: dependencies.AppServices, caller: dependencies.Caller
) -> Response:
    """Return the report as a page that needs nothing else."""
    body = report_html(services.reports.of(session_id)).encode()
    return _exported(session_id, services, caller, body, "html", "text/html; charset=utf-8")


@router.get(
    "/{session_id}/waveform.dcm",
    response_class=Response,
    responses={200: {"description": "The curve", "content": {DICOM: BINARY}}},
)
def export_waveform(
    session_id: dependencies.SessionId,
    services: dependencies.AppServices,
    caller: dependencies.Caller,
    deidentify_as: Annotated[
        str | None,
        Query(min_length=1, max_length=64, description="Patient ID in place of the patient's; times and plan go too"),
    ] = None,
) -> Response:
    """Return thorax and abdomen as a DICOM Multi-channel Respiratory Waveform, with beam and gate as annotations."""
    body = services.exports.waveform(session_id, deidentify_as)
    return _exported(
        session_id, services, caller, body, "dcm" if deidentify_as is None else "dcm, de-identified", DICOM
    )


@router.get(
    "/{session_id}/report.dcm",
    response_class=Response,
    responses={200: {"description": "The report", "content": {DICOM: BINARY}}},
)
def export_report_dicom(
    session_id: dependencies.SessionId, services: dependencies.AppServices, caller: dependencies.Caller
) -> Response:
    """Return the PDF report as a DICOM Encapsulated PDF."""
    return _exported(session_id, services, caller, services.exports.report(session_id), "report.dcm", DICOM)


def _exported(
    session_id: str,
    services: dependencies.AppServices,
    caller: dependencies.Caller,
    body: bytes,
    form: str,
    media_type: str,
) -> Response:
    services.audit.exported(actor=caller.name, action="report.export", session_id=session_id, detail={"format": form})
    headers = {"Content-Disposition": f'attachment; filename="{session_id}.{form.partition(",")[0]}"'}
    return Response(body, media_type=media_type, headers=headers)


@router.get(
    "/{session_id}/picture",
    response_class=Response,
    responses={
        200: {"description": "Newest colour frame", "content": {"image/jpeg": BINARY}},
    },
)
def read_picture(session_id: dependencies.SessionId, services: dependencies.AppServices) -> Response:
    """Return the newest colour frame; `X-Frame-Index` is its index."""
    picture = services.runner.picture(session_id)
    headers = {"X-Frame-Index": str(picture.frame_index), "Cache-Control": "no-store"}
    return Response(picture.jpeg, media_type="image/jpeg", headers=headers)


@router.get("/{session_id}/mesh")
def read_mesh(session_id: dependencies.SessionId, services: dependencies.AppServices) -> sessions.SurfaceMesh:
    """Return the surface of the newest frame as a mesh, in the depth camera's frame."""
    return services.runner.mesh(session_id)


@router.get("/{session_id}/transitions")
def list_transitions(
    session_id: dependencies.SessionId,
    services: dependencies.AppServices,
    pages: dependencies.Pages200,
    to_state: Annotated[GateState | None, Query(description="Only transitions to this state")] = None,
    reason: Annotated[
        HoldReason | None, Query(description="Only transitions with this reason, see /interlocks")
    ] = None,
) -> sessions.TransitionPage:
    """List the gate's transitions, oldest first."""
    wanted = TransitionFilter(
        to_state=None if to_state is None else to_state.value, reason=None if reason is None else reason.value
    )
    return pages.answer(services.sessions.transitions(session_id, pages.cursor, pages.limit, wanted))
