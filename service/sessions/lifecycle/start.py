"""The start of a session: record it, create its sample file and journal, open its engine, start its writer."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from sqlalchemy.orm import Session

from engine import __version__
from engine.calibration import parse_calibration
from engine.control import LoopStatus
from engine.core.errors import TidegateError
from engine.core.fraction_arming import read_fraction_arming
from engine.core.motion_model import MAX_TEXT, ModelOrigin, MotionModel, check_patient
from engine.core.reference import read_first_reference
from engine.core.sentences import say
from service.core.errors import SessionActiveError, StartError, StorageUnwritableError
from service.core.late_modules import load_now
from service.core.schemas import sessions
from service.core.schemas.windows import Window
from service.core.settings.settings import Settings
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.protocols import EnginePort, RunningSession, SessionPlan
from service.engine_host.site_limits.calibrations import described
from service.engine_host.site_limits.recording_folders import described_source, find_recording
from service.sessions.alarms.watch import AlarmWatch
from service.sessions.lifecycle.body_comparison import earlier_body
from service.sessions.lifecycle.commands import state_error
from service.sessions.lifecycle.counters import SessionCounters
from service.sessions.lifecycle.writer import SessionWriter, WriterSettings
from service.sessions.records.sessions import SOURCE, head_of_row
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.check import redacted_settings, settings_sha256
from service.storage.database import queries
from service.storage.database.base import TimeAnchor, utc_text
from service.storage.database.engine import Database
from service.storage.files.journals import Journals
from service.storage.files.motion_models import ModelStore
from service.storage.samples.layout import SampleHead
from service.storage.samples.recorder import SampleRecorder
from service.storage.samples.store import SampleStore

SOFTWARE = f"tidegate {__version__}"
SAMPLE_BATCH_S = 0.25
"""Longest wait of a row for its batch; the engine holds after ``max_unwritten_ms``."""
WRITER_JOIN_S = 10.0
WRITER_BUSY_TIMEOUT_S = 0.5
WRITER_ANSWER_TIMEOUT_S = 1.0
START_TIMEOUT_S = 5.0
START_POLL_S = 0.01
MIB = 1024 * 1024


# The metadata of a session's sample file: software, settings, calibration and model.
def sample_head(plan: SessionPlan, settings: Settings, anchor: TimeAnchor) -> SampleHead:
    """Make the head of a session's file."""
    return SampleHead(
        session_id=plan.session_id,
        software=f"tidegate {__version__}",
        settings_sha256=settings_sha256(redacted_settings(settings)),
        calibration_sha256=plan.calibration.sha256,
        model_id=plan.model_id or "",
        regions=tuple(region.name for region in plan.regions.named),
        utc=utc_text(anchor.at),
        monotonic_ns=anchor.at_ns,
    )


# The origin that a learned motion model is stored with: patient, source and software.
def model_origin(plan: SessionPlan) -> ModelOrigin:
    """Return the origin of models learned in this session; the writer adds the time when it stores one."""
    camera = plan.source.uri if isinstance(plan.source, sessions.DeviceSource) else None
    source = camera or "camera" if plan.recording is None else plan.recording.name
    return ModelOrigin(patient=plan.patient_reference, source=source[-MAX_TEXT:], software=SOFTWARE)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SessionStarter:
    """Starts sessions.

    Attributes
    ----------
    writer_database
        The connections of the session writer.
    camera_latency_ms
        What the gate counts for a live camera, by its calibration's serial number [ms]; None for the site's value.
    """

    engine: EnginePort
    database: Database
    writer_database: Database
    models: ModelStore
    equipment: EquipmentSlot
    settings: Settings
    counters: SessionCounters
    samples: SampleStore
    journals: Journals
    alarms: AlarmWatch
    camera_latency_ms: Callable[[Session, str], float | None] = lambda _db, _serial: None

    def start(self, session_id: str, operator: str, action: str) -> RunningSession:
        """Record the start, then start the engine, disarmed, and the writer; raise what kept it from starting."""
        self._refuse_unless_created(session_id)
        load_now()
        with self.journals.begun(session_id) as journal:  # before the session is recorded as running
            plan = replace(self._begin(session_id, operator, action), journal=journal)
            try:
                running = self._open(plan)
                self._begin_writing(running)
            except Exception as error:
                self._mark_failed(session_id, _reason(error))
                raise
        return running

    def _refuse_unless_created(self, session_id: str) -> None:
        with self.database.read() as db:
            status = queries.session_row(db, session_id).status
        if status != "created":
            raise state_error(status, "created")

    def _begin(self, session_id: str, operator: str, action: str) -> SessionPlan:
        """Record that the session starts, and return what its engine needs."""
        self.equipment.refuse_qa()
        if self.equipment.running is not None and self.equipment.of(session_id) is None:
            msg = "another session runs"
            raise SessionActiveError(msg, field="session_id", bound="one running session at a time")
        with self.database.write() as db:
            row = queries.session_row(db, session_id)
            if row.status != "created":
                raise state_error(row.status, "created")
            document = queries.calibration_row(db, row.calibration_id).document
            source = SOURCE.validate_json(row.source)
            folders = self.settings.recording_folders
            first = queries.first_reference_of(db, row)
            position = queries.simulation_position_of(db, row) or queries.plan_position_of(db, row)
            armed = queries.fraction_arming_of(db, row)
            calibration = parse_calibration(document.encode())
            plan = SessionPlan(
                session_id=session_id,
                source=source,
                camera_latency_ms=self.camera_latency_ms(db, calibration.serial)
                if isinstance(source, sessions.DeviceSource)
                else None,
                recording=find_recording(source.path, folders)
                if isinstance(source, sessions.RecordingSource)
                else None,
                calibration=calibration,
                window=Window.model_validate_json(row.window),
                regions=sessions.Regions.model_validate_json(row.regions),
                patient_reference=row.patient_reference,
                model_id=row.model_id,
                head_direction=head_of_row(row.head_direction),
                first_reference=None if first is None else read_first_reference(first.document),
                plan_position=None if position is None else read_first_reference(position.document),
                fraction_arming=None if armed is None else read_fraction_arming(armed.document),
                plan_session_id=None if position is None else position.session_id,
                model=None if row.model_id is None else self._stored_model(db, row.model_id, row.patient_reference),
            )
            row.status, row.started_at = "running", datetime.now(UTC)
            row.is_simulated_beam = self.engine.is_simulated_beam  # the site may have changed its line since
            detail = {**self._beam_detail(source), **described(plan.calibration.camera), **_model_detail(row.model_id)}
            detail |= {} if plan.camera_latency_ms is None else {"camera_latency_ms": plan.camera_latency_ms}
            detail |= {} if first is None else {"first_reference_of_session": first.session_id}
            detail |= {} if armed is None else {"arming_of_session": armed.session_id}
            detail |= {} if position is None else {"position_of_session": position.session_id}
            audit.append(db, Event(actor=operator, action=action, session_id=session_id, detail=detail))
        return plan

    def _stored_model(self, db: Session, model_id: str, patient_reference: str) -> MotionModel:
        model = self.models.load(queries.model_row(db, model_id).sha256)
        check_patient(model.provenance.origin, patient_reference)  # by its file too, not by the table alone
        return model

    def _open(self, plan: SessionPlan) -> RunningSession:
        earlier = earlier_body(
            self.database, self.models, session_id=plan.session_id, patient_reference=plan.patient_reference
        )
        anchor = TimeAnchor.now()
        recorder = self._recorder(plan, anchor)
        try:
            engine = self.engine.open(plan)
        except BaseException:
            recorder.discard()
            raise
        writer = SessionWriter(
            session_id=plan.session_id,
            engine=engine,
            origin=model_origin(plan),
            database=self.writer_database,
            models=self.models,
            recorder=recorder,
            anchor=anchor,
            journal=plan.journal,
            earlier=earlier,
            settings=WriterSettings(
                data_dir=self.settings.data_dir,
                min_free_disk_bytes=self.settings.min_free_disk_mb * MIB,
                match_limits=self.settings.likeness,
            ),
            counters=self.counters,
            on_over=lambda: self._leave(running),
        )
        running = RunningSession(plan=plan, engine=engine, writer=writer)
        if not self.equipment.enter(running):
            engine.stop()
            recorder.discard()
            self.equipment.refuse_closed()
            msg = "another session runs"
            raise SessionActiveError(msg, field="session_id", bound="one running session at a time")
        return running

    def _leave(self, running: RunningSession) -> None:
        """Free the equipment of a session that is over; look for alarms first, while there is something to look at."""
        try:
            self.alarms.session_over(running)
        finally:
            self.equipment.leave(running.plan.session_id)

    def _begin_writing(self, running: RunningSession) -> None:
        """Start the writer's thread; stop the engine if that fails, because its decisions would not be recorded."""
        try:
            running.writer.start()
        except BaseException:
            running.engine.stop()
            self._leave(running)
            raise

    def _recorder(self, plan: SessionPlan, anchor: TimeAnchor) -> SampleRecorder:
        """Create the sample file before the engine starts, so that no frame is measured meanwhile."""
        head = sample_head(plan, self.settings, anchor)
        try:
            return SampleRecorder(self.samples, head, batch_s=SAMPLE_BATCH_S)
        except OSError as error:
            msg = f"no sample file can be created: {error.strerror}"
            raise StorageUnwritableError(msg) from error

    def _mark_failed(self, session_id: str, reason: str) -> None:
        with self.database.write() as db:
            row = queries.session_row(db, session_id)
            row.status, row.status_detail, row.ended_at = "failed", reason, datetime.now(UTC)

    def _beam_detail(self, source: sessions.RecordingSource | sessions.DeviceSource) -> dict[str, object]:
        if not self.engine.is_simulated_beam:
            return {"is_simulated_beam": False, **described_source(source, self.settings)}
        return {"is_simulated_beam": True, "beam_line": "SIMULATED: no accelerator is gated by this session"}


def _reason(error: Exception) -> str:
    """Return why a session failed, for its record; the details of an internal error stay in the log."""
    return (
        str(error) if isinstance(error, TidegateError) else f"the engine could not be opened ({type(error).__name__})"
    )


def _model_detail(model_id: str | None) -> dict[str, object]:
    if model_id is None:
        return {}
    return {"model_id": model_id, "reference": say("not carried over from the earlier session: a person has to set it")}


def writer_connections(database: Database) -> Database:
    """Return the writer's own connections: it must notice a locked database soon, to hold; people may wait longer."""
    return database.twin(busy_timeout_s=WRITER_BUSY_TIMEOUT_S, answer_timeout_s=WRITER_ANSWER_TIMEOUT_S)


def await_start(running: RunningSession) -> None:
    """Wait until the source is open; raise StartError where it cannot be opened, once the session is closed."""
    for _ in range(round(START_TIMEOUT_S / START_POLL_S)):
        if running.engine.status.run_state is not LoopStatus.STARTING:
            break
        time.sleep(START_POLL_S)
    if running.engine.status.run_state is LoopStatus.FAILED:
        running.writer.join(WRITER_JOIN_S)
        raise StartError(running.engine.status.error or "the engine failed")
