"""The running session: start, command and stop its engine. The gate alone decides whether the beam may be on."""

import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime

import cv2

from engine.capture import SourceDescription
from engine.control import LiveView
from engine.core.sentences import say
from service.core.errors import PictureMissingError
from service.core.schemas import sessions
from service.engine_host.protocols import LiveFrame, Picture, RunningSession
from service.sessions.lifecycle.commands import (
    EngineCommander,
    state_error,
)
from service.sessions.lifecycle.operator_commands import OperatorCommands
from service.sessions.lifecycle.start import WRITER_JOIN_S, SessionStarter, await_start
from service.sessions.records.etags import Withdrawals
from service.sessions.records.sessions import SessionRepository, session_answer
from service.sessions.views.live import camera_view, live_sample, mesh_answer
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database import queries
from service.storage.database.engine import ANSWER_TIMEOUT_S, BUSY_TIMEOUT_S

JPEG_QUALITY = 80
COMMAND_S = 3.0
"""Longest wait for the engine's answer; a command without one is cancelled."""
STOP = "session.stop"
CAMERA = "session.camera"


class SessionRunner:
    """Runs one session at a time; ``commands`` are what operators tell it.

    Parameters
    ----------
    starter
        Starts sessions; the runner uses its engine, database, models, equipment slot and settings, too.
    refuse_arming
        As of `OperatorCommands`.
    """

    def __init__(
        self,
        *,
        starter: SessionStarter,
        log: AuditLog,
        records: SessionRepository,
        refuse_arming: Callable[[SourceDescription | None], None] = lambda _source: None,
    ) -> None:
        self._starter = starter
        self._engine = starter.engine
        self._database, self._equipment = starter.database, starter.equipment
        # Connections reserved for hold, disarm and stop: no number of reads can delay their audit rows and answers.
        self._priority_database = starter.database.twin(
            busy_timeout_s=BUSY_TIMEOUT_S, answer_timeout_s=ANSWER_TIMEOUT_S
        )
        self._log, self._priority_log = log, AuditLog(self._priority_database)
        self._records = records
        # A stop during a start waits for this lock, and then finds the session in its slot.
        self._session_lock = starter.equipment.session_lock
        self._newest: tuple[LiveView, LiveFrame] | None = None
        self._commander = EngineCommander(
            equipment=starter.equipment,
            log=log,
            database=starter.database,
            priority_log=self._priority_log,
            priority_database=self._priority_database,
            answer_timeout_s=COMMAND_S,
        )
        self.commands = OperatorCommands(
            starter=starter, commander=self._commander, log=log, records=records, refuse_arming=refuse_arming
        )

    @property
    def withdrawals(self) -> Withdrawals:
        """Counts of holds, disarms and stops per session, for its ETag."""
        return self._commander.withdrawals

    def start(self, session_id: str, operator: str) -> sessions.Session:
        """Start its engine, disarmed."""
        action = "session.start"
        with self._log.refusals(actor=operator, action=action, session_id=session_id):
            with self._session_lock:
                running = self._starter.start(session_id, operator, action)
            await_start(running)
        self._record_camera(running)
        return self._records.detail(session_id)

    def _record_camera(self, running: RunningSession) -> None:
        """Record which camera was opened, and how its serial number compares with the calibration's."""
        source, calibration = running.engine.status.source, running.plan.calibration
        camera = camera_view(source, calibration)
        if source is None or camera is None or not source.is_live:
            return
        detail = {**camera.model_dump(), "calibration_serial": calibration.serial or None}
        self._log.write(Event(actor=audit.SYSTEM, action=CAMERA, session_id=running.plan.session_id, detail=detail))

    def running(self, session_id: str) -> RunningSession:
        """Return the session if it runs; else raise SessionStateError, or NotFoundError if it does not exist."""
        return self._commander.running(session_id)

    def is_running(self, session_id: str) -> bool:
        """Whether this session has an engine now, from memory."""
        return self._equipment.of(session_id) is not None

    def stop(self, session_id: str, operator: str) -> sessions.Session:
        """Hold the beam, end the engine, close the session; never refused while there is something to stop."""
        running = self._equipment.of(session_id)
        if running is None:
            refusals = self._log.refusals(actor=operator, action=STOP, session_id=session_id)
            # Under the lock no session is starting: this one is in the slot, or was not started.
            with refusals, self._session_lock:
                running = self._equipment.of(session_id)
                if running is None:
                    return self._close_unstarted(session_id, operator)
        running.writer.stopping(operator)
        with self.withdrawals.one(session_id):
            running.engine.stop()
        self._priority_log.write(Event(actor=operator, action=STOP, session_id=session_id))
        self._await_end(running)
        return self._records.detail(session_id, self._priority_database)

    def _close_unstarted(self, session_id: str, operator: str) -> sessions.Session:
        with self._database.write() as db:
            row = queries.session_row(db, session_id)
            if row.status != "created":
                raise state_error(row.status, "created or running")
            row.status, row.status_detail, row.ended_at = "stopped", f"stopped by {operator}", datetime.now(UTC)
            audit.append(db, Event(actor=operator, action=STOP, session_id=session_id))
            return session_answer(row)

    def shut_down(self) -> None:
        """Hold the beam, then stop and close the running session, because the service stops."""
        running = self._equipment.running
        if running is not None:
            running.writer.stopping(audit.SYSTEM, is_hurried=True)
            running.engine.stop()
            self._await_end(running)
        self._starter.writer_database.close()
        self._priority_database.close()

    def _await_end(self, running: RunningSession) -> None:
        """Wait until a stopped session is closed; its writer may not have started yet, or may have failed to start."""
        with suppress(RuntimeError):  # not started yet
            running.writer.join(WRITER_JOIN_S)
            return
        with self._session_lock:
            pass
        with suppress(RuntimeError):  # it failed to start
            running.writer.join(WRITER_JOIN_S)

    def picture(self, session_id: str) -> Picture:
        """Encode the newest colour frame."""
        running = self._equipment.of(session_id)
        found = None if running is None else running.engine.picture()
        if found is None:
            msg = say("the session does not run, or no frame has come yet")
            raise PictureMissingError(msg)
        frame_index, color = found
        picture = cv2.cvtColor(color, cv2.COLOR_RGB2BGR)
        _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return Picture(frame_index=frame_index, jpeg=jpeg.tobytes())

    def mesh(self, session_id: str) -> sessions.SurfaceMesh:
        """Return the surface of the newest frame; raise MeshMissingError without one."""
        return mesh_answer(self._equipment.view(session_id))

    def newest(self) -> LiveFrame | None:
        """Return the newest frame; the same object while nothing is newer."""
        running = self._equipment.running
        status = None if running is None else running.engine.status
        view = None if status is None else status.view
        if running is None or view is None:
            return None
        kept = self._newest
        if kept is None or kept[0] is not view:
            message = live_sample(
                view,
                running.plan,
                is_stopping=running.writer.is_stopping,
                is_simulated_beam=self._engine.is_simulated_beam,
                body=running.writer.body,
            )
            record = view.record
            frame = LiveFrame(
                message=message, received_ns=record.received_ns, captured_ns=record.captured_ns, status=status
            )
            kept = self._newest = (view, frame)
        return kept[1]

    def running_camera(self) -> str | None:
        """Return the running session's camera, by its calibration."""
        running = self._equipment.running
        return None if running is None else running.plan.calibration.camera

    def now_ns(self) -> int:
        """Return the engine's clock."""
        return time.monotonic_ns()
