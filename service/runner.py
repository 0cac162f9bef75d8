"""The session that runs: its engine started, asked and stopped.

Nothing here can turn a beam on: arming lets the gate decide.
What takes permission away is done first and written down after; what could lead to a permit is written down first, and
not done when it cannot be.
"""

import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from concurrent.futures import TimeoutError as FutureTimeoutError
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from datetime import UTC, datetime

import cv2
from sqlalchemy.orm import Session

from engine.calibration import parse_calibration
from engine.commands import (
    Acknowledge,
    ActivateModel,
    ApplyModel,
    Arm,
    Command,
    CorrectBaseline,
    Disarm,
    HoldBeam,
    ReleaseBeam,
    Retrain,
    SetReference,
)
from engine.errors import CommandRefusedError, TidegateError
from engine.live import LiveView, LoopStatus
from engine.mailbox import MAX_WAIT_NS
from engine.model import MotionModel
from engine.provenance import check_patient
from service import audit, schemas
from service.access.identity import Identity
from service.arrival import asked_ns
from service.audit import Event
from service.audit_log import AuditLog
from service.baseline import check_correction, correction_detail, moved_window, told_in
from service.bridge import SessionWriter, WriterSettings
from service.db import repository
from service.db.engine import ANSWER_TIMEOUT_S, BUSY_TIMEOUT_S, Database
from service.errors import (
    EngineTimeoutError,
    PictureMissingError,
    SessionActiveError,
    SessionStateError,
    StartError,
    StorageUnwritableError,
)
from service.gate_schemas import BaselineCorrectionRequest
from service.journals import Journals
from service.live_view import live_sample
from service.model_store import ModelStore, origin_of
from service.played_beam import described_source
from service.ports import CommandName, EnginePort, LiveFrame, Picture, RunningEngine, SessionPlan
from service.qa.requirement import refuse_without_qa
from service.recordings import find_recording
from service.room import Room, Running
from service.samples.heads import sample_head
from service.samples.recorder import SampleRecorder
from service.samples.shelf import SampleShelf
from service.sessions import SOURCE, SessionBook, session_answer
from service.settings import Settings
from service.surface_view import mesh_answer
from service.tallies import Tallies
from service.time_anchor import TimeAnchor
from service.uncalibrated import described
from service.window_schemas import Window
from service.withdrawals import Withdrawals

COMMANDS: dict[CommandName, Callable[[str], Command]] = {
    "arm": lambda operator: Arm(operator=operator),
    "disarm": lambda operator: Disarm(operator=operator),
    "reference": lambda operator: SetReference(operator=operator),
    "acknowledge": lambda operator: Acknowledge(operator=operator),
    "hold": lambda operator: HoldBeam(operator=operator),
    "release": lambda operator: ReleaseBeam(operator=operator),
}
AGES_FROM_ARRIVAL = (Arm, ReleaseBeam, SetReference, Acknowledge)
"""As old as the call that asks: what has to wait for a thread or the audit grows old there, too. What takes permission
away never grows old: it takes back all that came in before the engine is told."""
TAKES_PERMISSION_AWAY = (Disarm, HoldBeam)
"""Done first and written down after; all else is written down first."""

WRITER_BUSY_TIMEOUT_S = 0.5
WRITER_ANSWER_TIMEOUT_S = 1.0
WRITER_JOIN_S = 10.0
START_TIMEOUT_S = 5.0
START_POLL_S = 0.01
JPEG_QUALITY = 80
MIB = 1024 * 1024


class SessionRunner:
    """Runs one session at a time."""

    def __init__(
        self,
        *,
        engine: EnginePort,
        database: Database,
        log: AuditLog,
        book: SessionBook,
        models: ModelStore,
        room: Room,
        settings: Settings,
        tallies: Tallies,
        shelf: SampleShelf,
        journals: Journals,
    ) -> None:
        self._engine = engine
        self._database = database
        # The writer must notice a locked database quickly, to hold; people may wait longer for an answer.
        self._writer_database = database.twin(
            busy_timeout_s=WRITER_BUSY_TIMEOUT_S, answer_timeout_s=WRITER_ANSWER_TIMEOUT_S
        )
        # By connections that no read has: what takes permission away is written down, and answered, beside any number.
        self._own_database = database.twin(busy_timeout_s=BUSY_TIMEOUT_S, answer_timeout_s=ANSWER_TIMEOUT_S)
        self._own_log = AuditLog(self._own_database)
        self._log = log
        self._book = book
        self._models = models
        self._room = room
        self._settings = settings
        self._tallies = tallies
        self._shelf = shelf
        self._journals = journals
        # A stop that comes while a session starts waits for it, and then finds it.
        self._coming_and_going = room.coming_and_going
        self._newest: tuple[LiveView, LiveFrame] | None = None
        self.withdrawals = Withdrawals()

    def start(self, session_id: str, operator: str) -> schemas.Session:
        """Start its engine, disarmed."""
        action = "session.start"
        with self._log.refusals(actor=operator, action=action, session_id=session_id):
            with self._coming_and_going:
                running = self._enter(session_id, operator, action)
            _await_start(running)
        return self._book.detail(session_id)

    def command(
        self, session_id: str, name: CommandName, operator: str, *, may_be_done: Callable[[], None] = lambda: None
    ) -> schemas.SessionDetail:
        """Ask the engine; answers when it has done or refused it."""
        if name == "arm":
            with self._log.refusals(actor=operator, action="session.arm", session_id=session_id):
                refuse_without_qa(self._database, self._settings)
        command = COMMANDS[name](operator)
        self._ask(session_id, command, operator, f"session.{name}", may_be_done=may_be_done)
        return self._book.detail(session_id, self._own_database if _takes_permission_away(command) else None)

    def hold_unattended(self, session_id: str, armed_by: Identity) -> None:
        """Hold, as by hand, because whoever armed has no log-in or key any more."""
        detail: dict[str, object] = {
            "reason": f"{armed_by.name} armed, and is not logged in any more",
            "armed_by": armed_by.name,
        }
        self._ask(session_id, HoldBeam(operator=audit.SYSTEM), audit.SYSTEM, "session.hold", detail)

    def retrain(self, session_id: str, operator: str, *, keeps_reference: bool) -> schemas.SessionDetail:
        """Learn a new model in the background."""
        command = Retrain(operator=operator, keeps_zero=keeps_reference)
        self._ask(session_id, command, operator, "model.retrain", {"keeps_reference": keeps_reference})
        return self._book.detail(session_id)

    def apply_model(self, session_id: str, operator: str) -> schemas.SessionDetail:
        """Let the model that waits take over; disarms."""
        self._ask(session_id, ApplyModel(operator=operator), operator, "model.apply")
        return self._book.detail(session_id)

    def activate(self, model_id: str, operator: str) -> schemas.SessionDetail:
        """Measure with a stored model of the running session."""
        action = "model.activate"
        with self._log.refusals(actor=operator, action=action, detail={"model_id": model_id}):
            with self._database.read() as db:
                row = repository.model_row(db, model_id)
                session_id, sha256 = row.session_id, row.sha256
            self._running(session_id)
            model = self._models.load(sha256)
        detail: dict[str, object] = {"model_id": model_id, "sha256": sha256}
        self._ask(session_id, ActivateModel(operator=operator, model=model), operator, action, detail)
        return self._book.detail(session_id)

    def correct_baseline(self, session_id: str, request: BaselineCorrectionRequest) -> schemas.SessionDetail:
        """Move the window by a drift that a person saw and confirms; disarms."""
        action = "session.baseline_correction"
        running = self._room.of(session_id)
        before = None if running is None else running.engine.latest
        detail = correction_detail(request, before)
        if running is not None:
            with self._log.refusals(actor=request.operator, action=action, session_id=session_id, detail=detail):
                check_correction(request, before, self._settings)
        command = CorrectBaseline(operator=request.operator, by=request.by)
        with told_in(request):
            self._ask(
                session_id, command, request.operator, action, detail, after=lambda now: moved_window(now, before)
            )
        return self._book.detail(session_id)

    def note_presence(self, session_id: str, operator: str) -> None:
        """Hear that a person's page is still looked at; every second, so it is not audited."""
        self._running(session_id).engine.note_presence(operator)

    def stop(self, session_id: str, operator: str) -> schemas.Session:
        """Hold the beam, end the engine, close the session; never refused while there is something to stop."""
        action = "session.stop"
        log, database = self._own_log, self._own_database
        running = self._room.of(session_id)
        if running is None:
            with self._coming_and_going:  # one that starts is waited for; whoever runs already waits for no other's
                running = self._room.of(session_id)
        if running is not None:
            running.writer.stopping(operator)
            with self.withdrawals.one(session_id):
                running.engine.stop()
            log.write(Event(actor=operator, action=action, session_id=session_id))
            self._await_end(running)
            return self._book.detail(session_id, database)
        with log.refusals(actor=operator, action=action, session_id=session_id), database.write() as db:
            row = repository.session_row(db, session_id)
            if row.status != "created":
                raise _state_error(row.status, "created or running")
            row.status, row.status_detail, row.ended_at = "stopped", f"stopped by {operator}", datetime.now(UTC)
            audit.append(db, Event(actor=operator, action=action, session_id=session_id))
            return session_answer(row)

    def shut_down(self) -> None:
        """Hold the beam, then close the running session: on the service's way out."""
        running = self._room.running
        if running is not None:
            running.writer.stopping(audit.SYSTEM, is_hurried=True)
            running.engine.stop()
            self._await_end(running)
        self._writer_database.close()
        self._own_database.close()

    def _await_end(self, running: Running) -> None:
        """Wait until a session that was stopped is closed; its writer may be about to begin."""
        if running.writer.ident is None:
            with self._coming_and_going:
                pass
        running.writer.join(WRITER_JOIN_S)

    def picture(self, session_id: str) -> Picture:
        """Encode the newest colour frame."""
        running = self._room.of(session_id)
        found = None if running is None else running.engine.picture()
        if found is None:
            msg = "the session does not run, or no frame has come yet"
            raise PictureMissingError(msg)
        frame_index, color = found
        picture = cv2.cvtColor(color, cv2.COLOR_RGB2BGR)
        _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return Picture(frame_index=frame_index, jpeg=jpeg.tobytes())

    def mesh(self, session_id: str) -> schemas.SurfaceMesh:
        """Tell the surface of the newest frame."""
        return mesh_answer(self._room.view(session_id))

    def newest(self) -> LiveFrame | None:
        """Return the newest frame; the same object while nothing is newer."""
        running = self._room.running
        view = None if running is None else running.engine.latest
        if running is None or view is None:
            return None
        kept = self._newest
        if kept is None or kept[0] is not view:
            message = live_sample(
                view,
                running.plan,
                is_stopping=running.writer.is_stopping,
                is_simulated_beam=self._engine.is_simulated_beam,
            )
            record = view.record
            frame = LiveFrame(message=message, received_ns=record.received_ns, captured_ns=record.captured_ns)
            kept = self._newest = (view, frame)
        return kept[1]

    def running_camera(self) -> str | None:
        """Return the running session's camera, by its calibration."""
        running = self._room.running
        return None if running is None else running.plan.calibration.camera

    def now_ns(self) -> int:
        """Return the engine's clock."""
        return time.monotonic_ns()

    def _enter(self, session_id: str, operator: str, action: str) -> Running:
        """Write down that the session starts, then start its engine and its writer."""
        self._refuse_unless_created(session_id)
        with self._journals.begun(session_id) as journal:  # before the session is said to run
            plan = replace(self._begin(session_id, operator, action), journal=journal)
            try:
                running = self._open(plan)
            except TidegateError as error:
                self._mark_failed(session_id, str(error))
                raise
        running.writer.start()
        return running

    def _refuse_unless_created(self, session_id: str) -> None:
        with self._database.read() as db:
            status = repository.session_row(db, session_id).status
        if status != "created":
            raise _state_error(status, "created")

    def _begin(self, session_id: str, operator: str, action: str) -> SessionPlan:
        """Write down that the session starts, and gather what its engine needs."""
        self._room.refuse_qa()
        if self._room.running is not None and self._room.of(session_id) is None:
            msg = "another session runs"
            raise SessionActiveError(msg, field="session_id", bound="one running session at a time")
        with self._database.write() as db:
            row = repository.session_row(db, session_id)
            if row.status != "created":
                raise _state_error(row.status, "created")
            document = repository.calibration_row(db, row.calibration_id).document
            source = SOURCE.validate_json(row.source)
            folders = self._settings.recording_folders
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
            row.is_simulated_beam = self._engine.is_simulated_beam  # the site's line may be another by now
            detail = {**self._beam_detail(source), **described(plan.calibration.camera), **_model_detail(row.model_id)}
            audit.append(db, Event(actor=operator, action=action, session_id=session_id, detail=detail))
        return plan

    def _stored_model(self, db: Session, model_id: str, patient_reference: str) -> MotionModel:
        model = self._models.load(repository.model_row(db, model_id).sha256)
        check_patient(model.provenance.origin, patient_reference)  # as its file says too, not the table alone
        return model

    def _open(self, plan: SessionPlan) -> Running:
        anchor = TimeAnchor.now()
        recorder = self._recorder(plan, anchor)
        try:
            engine = self._engine.open(plan)
        except BaseException:
            recorder.discard()
            raise
        writer = SessionWriter(
            session_id=plan.session_id,
            engine=engine,
            origin=origin_of(plan),
            database=self._writer_database,
            models=self._models,
            recorder=recorder,
            anchor=anchor,
            journal=plan.journal,
            settings=WriterSettings(
                data_dir=self._settings.data_dir,
                min_free_disk_bytes=self._settings.min_free_disk_mb * MIB,
            ),
            tallies=self._tallies,
            on_over=lambda: self._room.leave(plan.session_id),
        )
        running = Running(plan=plan, engine=engine, writer=writer)
        if not self._room.enter(running):
            engine.stop()
            recorder.discard()
            self._room.refuse_closed()
            msg = "another session runs"
            raise SessionActiveError(msg, field="session_id", bound="one running session at a time")
        return running

    def _recorder(self, plan: SessionPlan, anchor: TimeAnchor) -> SampleRecorder:
        """Begin the sample file: before the engine, so that nothing of it is done beside frames that are measured."""
        head = sample_head(plan, self._settings, anchor)
        try:
            return SampleRecorder(self._shelf, head, batch_s=self._settings.sample_batch_ms / 1000)
        except OSError as error:
            msg = f"no sample file can be begun: {error.strerror}"
            raise StorageUnwritableError(msg) from error

    def _mark_failed(self, session_id: str, reason: str) -> None:
        with self._database.write() as db:
            row = repository.session_row(db, session_id)
            row.status, row.status_detail, row.ended_at = "failed", reason, datetime.now(UTC)

    def _ask(
        self,
        session_id: str,
        command: Command,
        operator: str,
        action: str,
        detail: dict[str, object] | None = None,
        *,
        after: Callable[[RunningEngine], dict[str, object]] | None = None,
        may_be_done: Callable[[], None] = lambda: None,
    ) -> None:
        """Put a command to the engine and write down who asked, before and after; ``after`` finds what came of it."""
        done = Event(actor=operator, action=action, session_id=session_id, detail=detail or {})
        log = self._own_log if _takes_permission_away(command) else self._log
        with log.refusals(actor=operator, action=action, session_id=session_id, detail=detail):
            running = self._running(session_id)
            if not _takes_permission_away(command):
                _refuse_late(command)
                log.write(replace(done, outcome="requested"))
            with _unless_refused(may_be_done):
                self._await(running, command)
        found = {} if after is None else after(running.engine)
        log.write(replace(done, detail={**done.detail, **found}))

    def _await(self, running: Running, command: Command) -> None:
        with self.withdrawals.one(running.plan.session_id) if _takes_permission_away(command) else nullcontext():
            self._submit(running, command)

    def _submit(self, running: Running, command: Command) -> None:
        asked = asked_ns() if isinstance(command, AGES_FROM_ARRIVAL) else None
        future = running.engine.submit(command, submitted_ns=asked)
        try:
            future.result(self._settings.command_timeout_s)
        except (FutureTimeoutError, CancelledError) as error:
            future.cancel()  # an arm that comes too late must not surprise anyone
            msg = f"the engine did not answer within {self._settings.command_timeout_s:g} s"
            raise EngineTimeoutError(msg) from error

    def _running(self, session_id: str) -> Running:
        running = self._room.of(session_id)
        if running is None:
            with self._own_database.read() as db:
                raise _state_error(repository.session_row(db, session_id).status, "running")
        return running

    def _beam_detail(self, source: schemas.RecordingSource | schemas.DeviceSource) -> dict[str, object]:
        if not self._engine.is_simulated_beam:
            return {"is_simulated_beam": False, **described_source(source, self._settings)}
        return {"is_simulated_beam": True, "beam_line": "SIMULATED: no accelerator is gated by this session"}


@contextmanager
def _unless_refused(may_be_done: Callable[[], None]) -> Iterator[None]:
    """Call, unless the engine refused: what was not answered in time may be done all the same."""
    try:
        yield
    except CommandRefusedError:
        raise
    except BaseException:
        may_be_done()
        raise
    may_be_done()


def _takes_permission_away(command: Command) -> bool:
    return isinstance(command, TAKES_PERMISSION_AWAY)


def _refuse_late(command: Command) -> None:
    """Refuse what waited so long for its turn that whoever asked may have gone."""
    if isinstance(command, AGES_FROM_ARRIVAL) and time.monotonic_ns() - asked_ns() > MAX_WAIT_NS:
        msg = "the service was busy for too long: look, and ask again"
        raise CommandRefusedError(msg)


def _model_detail(model_id: str | None) -> dict[str, object]:
    if model_id is None:
        return {}
    return {"model_id": model_id, "reference": "not carried over from the earlier session: a person has to set it"}


def _state_error(status: str, bound: str) -> SessionStateError:
    msg = f"the session is {status}: it must be {bound}"
    return SessionStateError(msg, field="status", value=status, bound=bound)


def _await_start(running: Running) -> None:
    """Wait until the source is open; raise StartError when it could not be, once the session is closed."""
    for _ in range(round(START_TIMEOUT_S / START_POLL_S)):
        if running.engine.status is not LoopStatus.STARTING:
            break
        time.sleep(START_POLL_S)
    if running.engine.status is LoopStatus.FAILED:
        running.writer.join(WRITER_JOIN_S)
        raise StartError(running.engine.error or "the engine failed")
