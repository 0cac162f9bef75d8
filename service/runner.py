"""The session that runs: its engine started, asked and stopped. Nothing here turns a beam on: the gate decides."""

import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime

import cv2

from engine.commands import ActivateModel, ApplyModel, CorrectBaseline, HoldBeam, Retrain
from engine.live import LiveView
from service import audit, schemas
from service.access.identity import Identity
from service.asking import COMMANDS, Asker, state_error, takes_permission_away
from service.audit import Event
from service.audit_log import AuditLog
from service.baseline import check_correction, correction_detail, moved_window, told_in
from service.db import repository
from service.db.engine import ANSWER_TIMEOUT_S, BUSY_TIMEOUT_S, Database
from service.errors import PictureMissingError
from service.gate_schemas import BaselineCorrectionRequest
from service.journals import Journals
from service.live_view import live_sample
from service.model_store import ModelStore
from service.ports import CommandName, EnginePort, LiveFrame, Picture
from service.qa.requirement import refuse_without_qa
from service.room import Room, Running
from service.samples.shelf import SampleShelf
from service.sessions import SessionBook, session_answer
from service.settings import Settings
from service.starting import WRITER_JOIN_S, SessionStarter, await_start
from service.surface_view import mesh_answer
from service.tallies import Tallies
from service.withdrawals import Withdrawals

WRITER_BUSY_TIMEOUT_S = 0.5
WRITER_ANSWER_TIMEOUT_S = 1.0
JPEG_QUALITY = 80
STOP = "session.stop"


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
        self._undelayed_database = database.twin(busy_timeout_s=BUSY_TIMEOUT_S, answer_timeout_s=ANSWER_TIMEOUT_S)
        self._log, self._undelayed_log = log, AuditLog(self._undelayed_database)
        self._book = book
        self._models = models
        self._room = room
        self._settings = settings
        # A stop that comes while a session starts waits for it, and then finds it.
        self._coming_and_going = room.coming_and_going
        self._newest: tuple[LiveView, LiveFrame] | None = None
        self._starter = SessionStarter(
            engine=engine,
            database=database,
            writer_database=self._writer_database,
            models=models,
            room=room,
            settings=settings,
            tallies=tallies,
            shelf=shelf,
            journals=journals,
        )
        self._asker = Asker(
            room=room,
            log=log,
            database=database,
            undelayed_log=self._undelayed_log,
            undelayed_database=self._undelayed_database,
            answer_timeout_s=settings.command_timeout_s,
        )

    @property
    def withdrawals(self) -> Withdrawals:
        """How often permission was taken away."""
        return self._asker.withdrawals

    def start(self, session_id: str, operator: str) -> schemas.Session:
        """Start its engine, disarmed."""
        action = "session.start"
        with self._log.refusals(actor=operator, action=action, session_id=session_id):
            with self._coming_and_going:
                running = self._starter.start(session_id, operator, action)
            await_start(running)
        return self._book.detail(session_id)

    def command(
        self, session_id: str, name: CommandName, operator: str, *, may_be_done: Callable[[], None] = lambda: None
    ) -> schemas.SessionDetail:
        """Ask the engine; answers when it has done or refused it."""
        if name == "arm":
            with self._log.refusals(actor=operator, action="session.arm", session_id=session_id):
                refuse_without_qa(self._database, self._settings)
        command = COMMANDS[name](operator)
        self._asker.ask(session_id, command, operator, f"session.{name}", may_be_done=may_be_done)
        return self._book.detail(session_id, self._undelayed_database if takes_permission_away(command) else None)

    def hold_unattended(self, session_id: str, armed_by: Identity) -> None:
        """Hold, as by hand, because whoever armed has no log-in or key any more."""
        detail: dict[str, object] = {
            "reason": f"{armed_by.name} armed, and is not logged in any more",
            "armed_by": armed_by.name,
        }
        self._asker.ask(session_id, HoldBeam(operator=audit.SYSTEM), audit.SYSTEM, "session.hold", detail)

    def retrain(self, session_id: str, operator: str, *, keeps_reference: bool) -> schemas.SessionDetail:
        """Learn a new model in the background."""
        command = Retrain(operator=operator, keeps_zero=keeps_reference)
        self._asker.ask(session_id, command, operator, "model.retrain", {"keeps_reference": keeps_reference})
        return self._book.detail(session_id)

    def apply_model(self, session_id: str, operator: str) -> schemas.SessionDetail:
        """Let the model that waits take over; disarms."""
        self._asker.ask(session_id, ApplyModel(operator=operator), operator, "model.apply")
        return self._book.detail(session_id)

    def activate(self, model_id: str, operator: str) -> schemas.SessionDetail:
        """Measure with a stored model of the running session."""
        action = "model.activate"
        with self._log.refusals(actor=operator, action=action, detail={"model_id": model_id}):
            with self._database.read() as db:
                row = repository.model_row(db, model_id)
                session_id, sha256 = row.session_id, row.sha256
            self._asker.running(session_id)
            model = self._models.load(sha256)
        detail: dict[str, object] = {"model_id": model_id, "sha256": sha256}
        self._asker.ask(session_id, ActivateModel(operator=operator, model=model), operator, action, detail)
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
            self._asker.ask(
                session_id, command, request.operator, action, detail, after=lambda now: moved_window(now, before)
            )
        return self._book.detail(session_id)

    def note_presence(self, session_id: str, operator: str) -> None:
        """Hear that a person's page is still looked at; every second, so it is not audited."""
        self._asker.running(session_id).engine.note_presence(operator)

    def is_running(self, session_id: str) -> bool:
        """Whether this session has an engine now, from memory."""
        return self._room.of(session_id) is not None

    def stop(self, session_id: str, operator: str) -> schemas.Session:
        """Hold the beam, end the engine, close the session; never refused while there is something to stop."""
        running = self._room.of(session_id)
        if running is None:
            refusals = self._log.refusals(actor=operator, action=STOP, session_id=session_id)
            # One that starts is waited for, and none starts before this is done: it is in the room, or never was.
            with refusals, self._coming_and_going:
                running = self._room.of(session_id)
                if running is None:
                    return self._close_unstarted(session_id, operator)
        running.writer.stopping(operator)
        with self.withdrawals.one(session_id):
            running.engine.stop()
        self._undelayed_log.write(Event(actor=operator, action=STOP, session_id=session_id))
        self._await_end(running)
        return self._book.detail(session_id, self._undelayed_database)

    def _close_unstarted(self, session_id: str, operator: str) -> schemas.Session:
        with self._database.write() as db:
            row = repository.session_row(db, session_id)
            if row.status != "created":
                raise state_error(row.status, "created or running")
            row.status, row.status_detail, row.ended_at = "stopped", f"stopped by {operator}", datetime.now(UTC)
            audit.append(db, Event(actor=operator, action=STOP, session_id=session_id))
            return session_answer(row)

    def shut_down(self) -> None:
        """Hold the beam, then close the running session: on the service's way out."""
        running = self._room.running
        if running is not None:
            running.writer.stopping(audit.SYSTEM, is_hurried=True)
            running.engine.stop()
            self._await_end(running)
        self._writer_database.close()
        self._undelayed_database.close()

    def _await_end(self, running: Running) -> None:
        """Wait until a session that was stopped is closed; its writer may be about to begin, or could not."""
        with suppress(RuntimeError):  # not begun yet; who has begun and ended waits for nobody else's start
            running.writer.join(WRITER_JOIN_S)
            return
        with self._coming_and_going:
            pass
        with suppress(RuntimeError):  # never begun
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
