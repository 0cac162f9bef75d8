"""Sessions as records: created once, one open at a time, read with their figures.

Sessions that continue an earlier one of their fraction, as after a crash.

The earlier beam-on time is kept, to be shown. What is gated stays the same: another window, head direction, calibration
or other regions would escape the budget of the fraction (:mod:`engine.control.fraction_checks`).
"""

import json
import uuid
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime

from pydantic import TypeAdapter
from sqlalchemy.orm import Session

from engine.calibration import Calibration
from engine.control import LiveView
from engine.core.errors import ModelMismatchError
from engine.core.signals import HeadDirection
from service.core.errors import BoundError, NotFoundError, SessionActiveError
from service.core.list_filters import ALL_SESSIONS, ALL_TRANSITIONS, SessionFilter, TransitionFilter
from service.core.schemas import sessions
from service.core.schemas.base import finite_or_none, rounded_or_none
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.plug_ins import use_plug_ins
from service.engine_host.protocols import EnginePort, RunningSession
from service.engine_host.site_limits.calibrations import check_allowed, described, kind_of, warning_of
from service.engine_host.site_limits.recording_folders import (
    check_source,
    described_source,
    find_recording,
    warning_of_source,
)
from service.engine_host.site_limits.window_limits import check_head_direction, check_window, gate_limits
from service.sessions.alarms.board import AlarmBoard, live_alarms
from service.sessions.records.calibrations import kept_row
from service.sessions.views.breath import live_breath, live_breath_hold, live_window
from service.sessions.views.interlocks import live_checks
from service.sessions.views.live import body_view, camera_view, gate_view, likeness_view, training_view
from service.sessions.views.position import live_position_check, live_reference, proposal_views, tolerance_of
from service.storage import audit
from service.storage.audit import SYSTEM, Event
from service.storage.audit.log import AuditLog
from service.storage.database import identities, queries
from service.storage.database.engine import Database
from service.storage.database.idempotency import CallersKey, IdempotentAnswer, InProgress, earlier_answer, keep_answer
from service.storage.database.tables import AuditRow, CalibrationRow, SessionRow
from service.storage.files.cleanup import refuse_without_room
from service.storage.samples.figures import Figures

FIELD = "continues"
SAME = (
    *("patient_reference", "plan_id", "fraction_id", "fraction_number", "rt_plan_id", "is_simulated_beam"),
    *("window", "regions", "head_direction", "calibration_id"),
)
ACTION = "session.create"
ARMING = ("session.arm", "session.release")
SOURCE: TypeAdapter[sessions.RecordingSource | sessions.DeviceSource] = TypeAdapter(sessions.Source)


def continued(db: Session, row: SessionRow) -> dict[str, object]:
    """Check what a new session continues, and return what the audit records of it; nothing if it continues none."""
    if row.continues is None:
        return {}
    earlier = db.get(SessionRow, row.continues)
    if earlier is None:
        msg = "there is no such session"
        raise NotFoundError(msg, field=FIELD, value=row.continues)
    if earlier.started_at is None or earlier.status in queries.OPEN_STATUSES:
        raise _refusal(row.continues, "a session that was started and is over", f"this one is {earlier.status}")
    other = [name for name in SAME if getattr(earlier, name) != getattr(row, name)]
    if other:
        # The values may be another patient's.
        raise _refusal(row.continues, "a session of the same fraction", f"this one differs in {', '.join(other)}")
    later = queries.continuation_of(db, earlier.id)
    if later is not None:
        raise _refusal(row.continues, "a session that none continues", f"continue {later}")
    return {"delivered_before_s": delivered_before_s(db, row)}


def delivered_before_s(db: Session, row: SessionRow) -> float | None:
    """Return the beam-on time of all sessions that this one continues [s]; None without one, or if one has none."""
    if row.continues is None:
        return None
    total_s = 0.0
    # Each session continues an older one: the chain ends.
    earlier_id: str | None = row.continues
    while earlier_id is not None:
        earlier = queries.session_row(db, earlier_id)
        if earlier.summary is None:
            return None
        beam_on_s = sessions.Summary.model_validate_json(earlier.summary).beam_on_s
        if beam_on_s is None:
            return None
        total_s += beam_on_s
        earlier_id = earlier.continues
    return round(total_s, 3)


def _refusal(value: str, bound: str, advice: str) -> BoundError:
    return BoundError(f"{FIELD} must be {bound}: {advice}", field=FIELD, value=value, bound=bound)


@dataclass(frozen=True, slots=True, kw_only=True)
class FromPlan:
    """The plan of a new session: what the audit records of it, and the check that the plan still allows the session."""

    rt_plan_id: str
    detail: Mapping[str, object]
    check: Callable[[Session], None]


class SessionRepository:
    """Creates and reads the records of sessions."""

    def __init__(
        self,
        database: Database,
        log: AuditLog,
        settings: Settings,
        equipment: EquipmentSlot,
        engine: EnginePort,
        free_disk: Callable[[], object],
        alarms: AlarmBoard,
    ) -> None:
        self._database = database
        self._log = log
        self._settings = settings
        self._equipment = equipment
        self._engine = engine
        self._free_disk = free_disk
        self._alarms = alarms
        self._in_progress = InProgress()

    def create(
        self, request: sessions.SessionRequest, key: CallersKey | None, plan: FromPlan | None = None
    ) -> IdempotentAnswer[sessions.Session]:
        """Record a new session; one at a time."""
        origin = {} if plan is None else dict(plan.detail)
        body = audit.canonical_json({**request.model_dump(mode="json"), **origin}).encode()
        with self._log.refusals(actor=request.operator, action=ACTION), self._in_progress.only(key):
            with self._database.read() as db:
                earlier = self._earlier_or_free(db, request, key, body, plan)
            if earlier is not None:
                return IdempotentAnswer(answer=earlier, is_replay=True)
            refuse_without_room(self._settings, self._free_disk)
            # A camera may take its time to answer, or hang: never while the database is locked.
            nominal = self._nominal_calibration(request)
            return self._write_down(request, key, body, nominal, plan)

    def _write_down(
        self,
        request: sessions.SessionRequest,
        key: CallersKey | None,
        body: bytes,
        nominal: Calibration | None,
        plan: FromPlan | None,
    ) -> IdempotentAnswer[sessions.Session]:
        with self._database.write() as db:
            earlier = self._earlier_or_free(db, request, key, body, plan)
            if earlier is not None:
                return IdempotentAnswer(answer=earlier, is_replay=True)
            identity = identities.keep(db, request.patient_reference, request.plan_id, request.fraction_id)
            request = request.model_copy(update=identity._asdict())
            calibration = self._calibration(db, request, nominal)
            _refuse_other_model(db, request, calibration)
            row = _new_row(request, calibration.id, is_simulated_beam=self._engine.is_simulated_beam)
            row.rt_plan_id = None if plan is None else plan.rt_plan_id
            origin = dict({} if plan is None else plan.detail) | continued(db, row)
            db.add(row)
            db.flush()
            audit.append(db, self._created(row.id, request, calibration, origin))
            answer = session_answer(row)
            keep_answer(db, ACTION, key, body, answer)
        return IdempotentAnswer(answer=answer, is_replay=False)

    def page(self, cursor: str | None, limit: int, wanted: SessionFilter = ALL_SESSIONS) -> sessions.SessionPage:
        """List sessions, newest first."""
        with self._database.read() as db:
            rows, next_cursor = queries.session_page(db, cursor, limit, wanted)
            signed_by = queries.signers(db, [row.id for row in rows])
            items = [session_answer(row, signed_by.get(row.id, [])) for row in rows]
        return sessions.SessionPage(items=items, next_cursor=next_cursor)

    def detail(self, session_id: str, by: Database | None = None) -> sessions.SessionDetail:
        """Read one, with its present state; ``by`` is another database, where these connections may all be in use."""
        with (by or self._database).read() as db:
            row = queries.session_row(db, session_id)
            record = session_answer(row)
            stored = row.summary
            armed = queries.newest_done(db, session_id, ARMING)
            armed_by_at = None if armed is None else (armed.actor, datetime.fromisoformat(armed.at))
            changed = queries.newest_done(db, session_id, (queries.TRANSITION,))
            change = None if changed is None else (json.loads(changed.detail), datetime.fromisoformat(changed.at))
            delivered_s = delivered_before_s(db, row)
        running = self._equipment.of(session_id)
        view = None if running is None else running.engine.status.view
        return sessions.SessionDetail(
            **dict(record),
            gate=None if view is None else gate_view(view, armed_by_at, change),
            alarms=live_alarms(self._alarms.active_of(session_id)),
            measurement_state=None if view is None else view.record.measurement.state.value,
            training=None if view is None else training_view(view),
            active_model_id=None if running is None else running.writer.active_model_id,
            has_reference=None if running is None else running.engine.status.learning.has_reference,
            reference=None if view is None else live_reference(view),
            position_check=None if view is None or running is None else live_position_check(view, running.plan),
            checks=[] if view is None else live_checks(view),
            reference_proposals=[]
            if running is None
            else proposal_views(
                running.engine.status.learning, self._settings.max_reference_distance_mm, tolerance_of(self._settings)
            ),
            likeness=None if running is None else likeness_view(running.engine.status.learning.patient_match),
            gate_window=None if view is None else live_window(view.window, view.conditions, view.record.measurement),
            predicted_duty_percent=None
            if running is None
            else rounded_or_none(running.engine.status.predicted_duty_percent, 1),
            breath=None if view is None else live_breath(view),
            breath_hold=None if view is None else live_breath_hold(view),
            camera=None if running is None else camera_view(running.engine.status.source, running.plan.calibration),
            body=None if running is None else body_view(running.writer.body),
            delivered_before_s=delivered_s,
            summary=_summary(running, view, stored).model_copy(update={"elapsed_s": _elapsed_s(record)}),
        )

    def transitions(
        self, session_id: str, cursor: str | None, limit: int, wanted: TransitionFilter = ALL_TRANSITIONS
    ) -> sessions.TransitionPage:
        """List its gate's transitions, oldest first."""
        with self._database.read() as db:
            queries.session_row(db, session_id)
            rows, next_cursor = queries.transition_page(db, session_id, cursor, limit, wanted)
            return sessions.TransitionPage(items=[_transition(row) for row in rows], next_cursor=next_cursor)

    def _check(self, request: sessions.SessionRequest) -> None:
        check_source(request.source, self._settings)
        check_window(request.window, self._settings)
        gate_limits(request.window, self._settings, request.regions)
        check_head_direction(head_of_row(request.head_direction), self._settings)
        if isinstance(request.source, sessions.RecordingSource):
            find_recording(request.source.path, self._settings.recording_folders)

    def _earlier_or_free(
        self,
        db: Session,
        request: sessions.SessionRequest,
        key: CallersKey | None,
        body: bytes,
        plan: FromPlan | None,
    ) -> sessions.Session | None:
        """Return the earlier answer to this key, if any; refuse an invalid request, and any while a session is open."""
        earlier = earlier_answer(db, ACTION, key, body, sessions.Session)
        if earlier is not None:
            return earlier
        self._check(request)
        if plan is not None:
            plan.check(db)
        self._equipment.refuse_qa()
        open_id = queries.open_session_id(db)
        if open_id is not None:
            msg = "another session is created or running: stop it first"
            raise SessionActiveError(msg, field="session_id", value=open_id, bound="one open session at a time")
        return None

    def _nominal_calibration(self, request: sessions.SessionRequest) -> Calibration | None:
        """Read the camera's nominal calibration if the request names none."""
        if request.calibration_id is not None:
            return None
        check_allowed(request, self._settings)
        assert isinstance(request.source, sessions.DeviceSource), "recordings were refused"
        return self._engine.built_in_calibration(request.source.uri)

    def _calibration(
        self, db: Session, request: sessions.SessionRequest, nominal: Calibration | None
    ) -> CalibrationRow:
        """Find the requested calibration, or store the nominal one."""
        if nominal is not None:
            return kept_row(db, nominal, SYSTEM)[0]
        assert request.calibration_id is not None, "without one there is a nominal one"
        row = queries.calibration_row(db, request.calibration_id)
        if kind_of(row.camera) != "uploaded":
            check_allowed(request, self._settings)
        return row

    def _created(
        self,
        session_id: str,
        request: sessions.SessionRequest,
        calibration: CalibrationRow,
        origin: Mapping[str, object],
    ) -> Event:
        detail = {**request.model_dump(mode="json"), "calibration_id": calibration.id, **described(calibration.camera)}
        # What the report names: the settings may be others by then.
        detail |= {**origin, "room": self._settings.room, "machine": self._settings.machine_name}
        plug_ins = [one.label for one in use_plug_ins(self._settings)]
        if plug_ins:  # a report without one stays what was signed
            detail["plug_ins"] = plug_ins
        if self._engine.is_simulated_beam:
            detail["beam_line"] = "SIMULATED: no accelerator is gated by this session"
        detail |= described_source(request.source, self._settings)
        return Event(actor=request.operator, action=ACTION, session_id=session_id, detail=detail)


def session_answer(row: SessionRow, signed_by: Sequence[str] = ()) -> sessions.Session:
    """Return a session's record as the API answers it."""
    made = {"signed_by", "source", "source_warning", "window", "regions", "calibration", "calibration_warning"}
    source = SOURCE.validate_json(row.source)
    return sessions.Session(
        **{name: getattr(row, name) for name in sessions.Session.model_fields.keys() - made},
        signed_by=list(signed_by),
        calibration=kind_of(row.calibration.camera),
        calibration_warning=warning_of(row.calibration.camera),
        source=source,
        source_warning=warning_of_source(source, is_simulated_beam=row.is_simulated_beam),
        window=Window.model_validate_json(row.window),
        regions=sessions.Regions.model_validate_json(row.regions),
    )


def head_of_row(stored: str | None) -> HeadDirection | None:
    """Return a session's head direction, as stored or requested."""
    return None if stored is None else HeadDirection(stored)


def _summary(running: RunningSession | None, view: LiveView | None, stored: str | None) -> sessions.Summary:
    """Return a closed session's stored figures, or a running one's present counts."""
    if stored is not None:
        return sessions.Summary.model_validate_json(stored)
    figures = Figures() if running is None else running.writer.figures
    if view is None:
        return figures.summary(sessions.LatencyView(p50_ms=None, p99_ms=None))
    latency = sessions.LatencyView(
        p50_ms=finite_or_none(view.latency.p50_ms),
        p99_ms=finite_or_none(view.latency.p99_ms),
        max_ms=finite_or_none(view.latency.max_ms),
    )
    return figures.summary(latency)


def _elapsed_s(record: sessions.Session) -> float | None:
    """Return the time from the start to the end, or to now [s]."""
    if record.started_at is None:
        return None
    return round(((record.ended_at or datetime.now(UTC)) - record.started_at).total_seconds(), 3)


def _refuse_other_model(db: Session, request: sessions.SessionRequest, calibration: CalibrationRow) -> None:
    """Refuse a model of another patient, calibration or head direction; the message does not name the other patient."""
    if request.model_id is None:
        return
    learned_in = queries.session_row(db, queries.model_row(db, request.model_id).session_id)
    if learned_in.patient_reference != request.patient_reference:
        bound = f"a model of {request.patient_reference}"
        raise ModelMismatchError("model_id", request.model_id, bound, "this one was learned of another patient")
    if learned_in.calibration.sha256 != calibration.sha256:
        bound = f"a model learned with calibration {calibration.id}"
        raise ModelMismatchError("model_id", request.model_id, bound, f"this one was with {learned_in.calibration_id}")
    if len({learned_in.head_direction, request.head_direction} - {None}) > 1:
        bound = f"a model learned with the head at the {request.head_direction} of the picture"
        advice = f"this one was with the head at the {learned_in.head_direction}"
        raise ModelMismatchError("model_id", request.model_id, bound, advice)


def _new_row(request: sessions.SessionRequest, calibration_id: str, *, is_simulated_beam: bool) -> SessionRow:
    return SessionRow(
        id=uuid.uuid4().hex,
        status="created",
        status_detail="",
        patient_reference=request.patient_reference,
        plan_id=request.plan_id,
        fraction_id=request.fraction_id,
        fraction_number=request.fraction_number,
        operator=request.operator,
        source=request.source.model_dump_json(),
        window=request.window.model_dump_json(),
        regions=request.regions.model_dump_json(),
        calibration_id=calibration_id,
        model_id=request.model_id,
        head_direction=request.head_direction,
        continues=request.continues,
        is_simulated_beam=is_simulated_beam,
        created_at=datetime.now(UTC),
    )


def _transition(row: AuditRow) -> sessions.Transition:
    return sessions.Transition.model_validate({**json.loads(row.detail), "audit_sequence": row.sequence, "at": row.at})
