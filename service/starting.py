"""A session is started: written down, its engine opened, its writer and its sample file begun."""

import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime

from sqlalchemy.orm import Session

from engine.calibration import parse_calibration
from engine.errors import TidegateError
from engine.live import LoopStatus
from engine.model import MotionModel
from engine.provenance import check_patient
from service import audit, schemas
from service.asking import state_error
from service.audit import Event
from service.bridge import SessionWriter, WriterSettings
from service.db import repository
from service.db.engine import Database
from service.errors import SessionActiveError, StartError, StorageUnwritableError
from service.journals import Journals
from service.model_store import ModelStore, origin_of
from service.played_beam import described_source
from service.ports import EnginePort, SessionPlan
from service.recordings import find_recording
from service.room import Room, Running
from service.samples.heads import sample_head
from service.samples.recorder import SampleRecorder
from service.samples.shelf import SampleShelf
from service.sessions import SOURCE
from service.settings import Settings
from service.tallies import Tallies
from service.time_anchor import TimeAnchor
from service.uncalibrated import described
from service.window_schemas import Window

WRITER_JOIN_S = 10.0
START_TIMEOUT_S = 5.0
START_POLL_S = 0.01
MIB = 1024 * 1024


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SessionStarter:
    """See the module; ``writer_database`` is the writer's own way to the database."""

    engine: EnginePort
    database: Database
    writer_database: Database
    models: ModelStore
    room: Room
    settings: Settings
    tallies: Tallies
    shelf: SampleShelf
    journals: Journals

    def start(self, session_id: str, operator: str, action: str) -> Running:
        """Write down that it starts, then start its engine and its writer."""
        self._refuse_unless_created(session_id)
        with self.journals.begun(session_id) as journal:  # before the session is said to run
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
            status = repository.session_row(db, session_id).status
        if status != "created":
            raise state_error(status, "created")

    def _begin(self, session_id: str, operator: str, action: str) -> SessionPlan:
        """Write down that the session starts, and gather what its engine needs."""
        self.room.refuse_qa()
        if self.room.running is not None and self.room.of(session_id) is None:
            msg = "another session runs"
            raise SessionActiveError(msg, field="session_id", bound="one running session at a time")
        with self.database.write() as db:
            row = repository.session_row(db, session_id)
            if row.status != "created":
                raise state_error(row.status, "created")
            document = repository.calibration_row(db, row.calibration_id).document
            source = SOURCE.validate_json(row.source)
            folders = self.settings.recording_folders
            plan = SessionPlan(
                session_id=session_id,
                source=source,
                recording=find_recording(source.path, folders) if isinstance(source, schemas.RecordingSource) else None,
                calibration=parse_calibration(document.encode()),
                window=Window.model_validate_json(row.window),
                regions=schemas.Regions.model_validate_json(row.regions),
                patient_reference=row.patient_reference,
                model_id=row.model_id,
                model=None if row.model_id is None else self._stored_model(db, row.model_id, row.patient_reference),
            )
            row.status, row.started_at = "running", datetime.now(UTC)
            row.is_simulated_beam = self.engine.is_simulated_beam  # the site's line may be another by now
            detail = {**self._beam_detail(source), **described(plan.calibration.camera), **_model_detail(row.model_id)}
            audit.append(db, Event(actor=operator, action=action, session_id=session_id, detail=detail))
        return plan

    def _stored_model(self, db: Session, model_id: str, patient_reference: str) -> MotionModel:
        model = self.models.load(repository.model_row(db, model_id).sha256)
        check_patient(model.provenance.origin, patient_reference)  # as its file says too, not the table alone
        return model

    def _open(self, plan: SessionPlan) -> Running:
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
            origin=origin_of(plan),
            database=self.writer_database,
            models=self.models,
            recorder=recorder,
            anchor=anchor,
            journal=plan.journal,
            settings=WriterSettings(
                data_dir=self.settings.data_dir,
                min_free_disk_bytes=self.settings.min_free_disk_mb * MIB,
            ),
            tallies=self.tallies,
            on_over=lambda: self.room.leave(plan.session_id),
        )
        running = Running(plan=plan, engine=engine, writer=writer)
        if not self.room.enter(running):
            engine.stop()
            recorder.discard()
            self.room.refuse_closed()
            msg = "another session runs"
            raise SessionActiveError(msg, field="session_id", bound="one running session at a time")
        return running

    def _begin_writing(self, running: Running) -> None:
        """Begin the writer's thread; an engine whose decisions nobody would write down is not left to itself."""
        try:
            running.writer.start()
        except BaseException:
            running.engine.stop()
            self.room.leave(running.plan.session_id)
            raise

    def _recorder(self, plan: SessionPlan, anchor: TimeAnchor) -> SampleRecorder:
        """Begin the sample file: before the engine, so that nothing of it is done beside frames that are measured."""
        head = sample_head(plan, self.settings, anchor)
        try:
            return SampleRecorder(self.shelf, head, batch_s=self.settings.sample_batch_ms / 1000)
        except OSError as error:
            msg = f"no sample file can be begun: {error.strerror}"
            raise StorageUnwritableError(msg) from error

    def _mark_failed(self, session_id: str, reason: str) -> None:
        with self.database.write() as db:
            row = repository.session_row(db, session_id)
            row.status, row.status_detail, row.ended_at = "failed", reason, datetime.now(UTC)

    def _beam_detail(self, source: schemas.RecordingSource | schemas.DeviceSource) -> dict[str, object]:
        if not self.engine.is_simulated_beam:
            return {"is_simulated_beam": False, **described_source(source, self.settings)}
        return {"is_simulated_beam": True, "beam_line": "SIMULATED: no accelerator is gated by this session"}


def _reason(error: Exception) -> str:
    """Say why a session failed: what is wrong inside is the log's, not the patient's record's."""
    return (
        str(error) if isinstance(error, TidegateError) else f"the engine could not be opened ({type(error).__name__})"
    )


def _model_detail(model_id: str | None) -> dict[str, object]:
    if model_id is None:
        return {}
    return {"model_id": model_id, "reference": "not carried over from the earlier session: a person has to set it"}


def await_start(running: Running) -> None:
    """Wait until the source is open; raise StartError when it could not be, once the session is closed."""
    for _ in range(round(START_TIMEOUT_S / START_POLL_S)):
        if running.engine.status is not LoopStatus.STARTING:
            break
        time.sleep(START_POLL_S)
    if running.engine.status is LoopStatus.FAILED:
        running.writer.join(WRITER_JOIN_S)
        raise StartError(running.engine.error or "the engine failed")
