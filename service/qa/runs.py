"""Start and cancel QA runs: one at a time, on a worker thread, not while a session is created or running."""

import hashlib
import threading
import uuid
from datetime import datetime
from pathlib import Path

from sqlalchemy.orm import Session

from engine.calibration import Calibration, parse_calibration
from engine.core.errors import RecordingError
from engine.qa import QaKind
from service.core.errors import BoundError, QaStateError, SessionActiveError
from service.core.settings.settings import Settings
from service.engine_host.equipment import EquipmentSlot
from service.engine_host.site_limits.calibrations import check_still_allowed
from service.engine_host.site_limits.recording_folders import find_recording
from service.qa import queries as records, schemas, views
from service.qa.jobs import Current, CurrentRun, Handle, QaFiles, QaJob, QaRig, run_job
from service.qa.one_time_code import OneTimeCodes
from service.qa.queries import NewQaRun, QaOutcome
from service.storage import audit
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database import queries
from service.storage.database.engine import ANSWER_TIMEOUT_S, BUSY_TIMEOUT_S, Database
from service.storage.database.idempotency import CallersKey, IdempotentAnswer, InProgress, earlier_answer, keep_answer

CANCEL = "qa.cancel"
JOIN_S = 10.0


class QaRunService:
    """Starts and cancels QA runs."""

    def __init__(
        self,
        *,
        database: Database,
        log: AuditLog,
        settings: Settings,
        equipment: EquipmentSlot,
        rig: QaRig,
        current_run: CurrentRun,
    ) -> None:
        self._database = database
        self._log = log
        # Own connections, so that reads cannot delay a cancel or the end of a run.
        self._priority_database = database.twin(busy_timeout_s=BUSY_TIMEOUT_S, answer_timeout_s=ANSWER_TIMEOUT_S)
        self._priority_log = AuditLog(self._priority_database)
        self._settings = settings
        self._equipment = equipment
        self._rig = rig
        self._current_run = current_run
        self._codes = OneTimeCodes(settings.data_dir)
        self._thread: threading.Thread | None = None
        self._in_progress = InProgress()

    def start(self, request: schemas.QaRunRequest, key: CallersKey | None) -> IdempotentAnswer[schemas.QaRun]:
        """Start a run and return it; an idempotency key replays the first answer.

        Raises
        ------
        TidegateError
            A session is created or running, another run uses camera and line, an input cannot be used, the beam is not
            declared safe, or the code from the machine is missing or not valid.
        """
        # Without the code: a repeated request with a new one gets the first answer too.
        body = audit.canonical_json(request.model_dump(mode="json", exclude={"code"})).encode()
        with self._log.refusals(actor=request.operator, action=records.START), self._in_progress.only(key):
            with self._database.read() as db:
                earlier = earlier_answer(db, records.START, key, body, schemas.QaRun)
                if earlier is not None:
                    return IdempotentAnswer(answer=earlier, is_replay=True)
                check_beam_safety(request, self._settings)
                self._equipment.refuse_closed()
                refuse_open_session(db)
                calibration = self._calibration(db, request)
            files = self._files(request)
            job = self._rig.job(request, files, calibration)
            run_id = uuid.uuid4().hex
            self._equipment.enter_qa(run_id)
            try:
                code_made_at = self._redeemed(request)
                answer = self._begin(request, key, body, run_id, job, calibration, files, code_made_at)
            except BaseException:
                self._current_run.current = None
                self._equipment.leave_qa(run_id)
                raise
        return IdempotentAnswer(answer=answer, is_replay=False)

    def _redeemed(self, request: schemas.QaRunRequest) -> datetime | None:
        """Use up the code of a run with real pulses and return when it was made; None for other runs."""
        if not permits_real_beam(request, self._settings):
            return None
        code = request.code
        return self._codes.redeem(None if code is None else code.get_secret_value(), request.operator)

    def is_under_way(self, run_id: str) -> bool:
        """Whether this run is in progress; does not read the database."""
        return self._current_run.run_id == run_id

    def cancel(self, run_id: str, operator: str) -> schemas.QaRun:
        """Hold the line, then end the run; raise QaStateError if it has ended."""
        current = self._current_run.current
        if current is None or current.run_id != run_id:
            with self._log.refusals(actor=operator, action=CANCEL, detail={"run_id": run_id}):
                raise _over(self._answer(run_id, self._database).status)
        current.handle.cancel(operator)  # before any database access
        self._priority_log.write(Event(actor=operator, action=CANCEL, detail={"run_id": run_id}))
        self._join()
        return self._answer(run_id, self._priority_database)

    def _answer(self, run_id: str, database: Database) -> schemas.QaRun:
        with database.read() as db:
            return self._current_run.run_answer(db, records.run_row(db, run_id))

    def shut_down(self) -> None:
        """Hold the line, end the run and close the connections; call it after the equipment slot is closed."""
        current = self._current_run.current
        if current is not None:
            current.handle.cancel(audit.SYSTEM)
            self._join()
        self._priority_database.close()

    def _begin(
        self,
        request: schemas.QaRunRequest,
        key: CallersKey | None,
        body: bytes,
        run_id: str,
        job: QaJob,
        calibration: Calibration | None,
        files: QaFiles,
        code_made_at: datetime | None,
    ) -> schemas.QaRun:
        """Store the run, then start its thread."""
        handle = Handle(job.line)
        run = new_run(
            request, self._settings, run_id=run_id, calibration=calibration, files=files, code_made_at=code_made_at
        )
        with self._database.write() as db:
            # Again, with the equipment entered and under the write lock: no session is created at the same time.
            refuse_open_session(db)
            row = records.begin(db, run)
            answer = views.run_answer(db, row, is_under_way=True)
            keep_answer(db, records.START, key, body, answer)
            baseline = job.own_baseline or records.baseline_of(records.newest_baseline(db))
        self._current_run.current = Current(run_id=run_id, handle=handle)
        if self._equipment.is_closed:  # a shutdown may have read current_run before it was set
            handle.cancel(audit.SYSTEM)

        def work() -> None:
            run_job(
                job, handle, bounds=run.bounds, baseline=baseline, on_end=lambda outcome: self._end(run_id, outcome)
            )

        self._thread = threading.Thread(target=work, name="qa", daemon=True)
        self._thread.start()
        return answer

    def _end(self, run_id: str, outcome: QaOutcome) -> None:
        try:
            with self._priority_database.write() as db:  # a cancel waits for this write
                records.end(db, run_id, outcome)
        finally:
            self._current_run.current = None
            self._equipment.leave_qa(run_id)

    def _join(self) -> None:
        thread = self._thread
        if thread is not None:
            thread.join(JOIN_S)

    def _calibration(self, db: Session, request: schemas.QaRunRequest) -> Calibration | None:
        if request.calibration_id is None:
            return None
        calibration = parse_calibration(queries.calibration_row(db, request.calibration_id).document.encode())
        check_still_allowed(calibration, self._settings)
        return calibration

    def _files(self, request: schemas.QaRunRequest) -> QaFiles:
        plate, phantom, folders = request.plate, request.phantom, self._settings.recording_folders
        found = {}
        for name, part in (("plate", plate), ("phantom", phantom)):
            if part is not None and isinstance(part.source, schemas.QaRecording):
                found[name] = find_recording(part.source.path, folders, f"{name}.source.path")
        if phantom is not None:
            found["trace"] = find_recording(phantom.trace, folders, "phantom.trace")
        return QaFiles(**found)


def check_beam_safety(request: schemas.QaRunRequest, settings: Settings) -> None:
    """Refuse a run with a real beam that the operator has not declared safe, and a simulated run in clinical mode.

    A code is refused where no real line is permitted, because it would suggest that the run needs one.
    """
    if request.code is not None and not permits_real_beam(request, settings):
        bound = "omitted: this run permits no real beam line"
        msg = f"code must be {bound}"
        raise BoundError(msg, field="code", value="given", bound=bound)
    if request.is_simulated and settings.mode == "clinical":
        bound = "omitted: clinical mode permits no simulation"
        msg = f"simulation must be {bound}"
        raise BoundError(msg, field="simulation", value="given", bound=bound)
    if permits_real_beam(request, settings) and not request.is_beam_safe:
        bound = (
            f"true: the drills permit the real beam ({' and '.join(settings.beam_lines)}) without gating. Set it "
            "when the treatment room is empty and the accelerator is in a safe state"
        )
        msg = f"is_beam_safe must be {bound}"
        raise BoundError(msg, field="is_beam_safe", value=request.is_beam_safe, bound=bound)


def permits_real_beam(request: schemas.QaRunRequest, settings: Settings) -> bool:
    """Whether the drills of a run permit a real beam line."""
    return settings.has_real_beam and not request.is_simulated


def refuse_open_session(db: Session) -> None:
    """Raise SessionActiveError while a session is created or running: its patient may lie on the couch."""
    session_id = queries.open_session_id(db)
    if session_id is not None:
        msg = "a session is created or running, and its patient may lie on the couch: stop it before QA"
        raise SessionActiveError(
            msg, field="session_id", value=session_id, bound="no session created or running beside a QA run"
        )


def new_run(
    request: schemas.QaRunRequest,
    settings: Settings,
    *,
    run_id: str,
    calibration: Calibration | None,
    files: QaFiles,
    code_made_at: datetime | None = None,
) -> NewQaRun:
    """Return the record of a new run; ``code_made_at`` is when its one-time code was made."""
    recorded = request.model_dump(mode="json", exclude_none=True, exclude={"operator", "kind", "code"})
    recorded["beam_place"] = settings.beam_place
    if code_made_at is not None:
        recorded["code_made_at"] = code_made_at.isoformat()
    if calibration is not None:
        recorded |= {"calibration_sha256": calibration.sha256, "camera": calibration.camera}
    return NewQaRun(
        run_id=run_id,
        kind=QaKind(request.kind),
        operator=request.operator,
        request=recorded,
        site=settings.site_name,
        machine=settings.machine_name,
        bounds=settings.qa_bounds,
        is_simulated=request.is_simulated,
        is_simulated_beam=settings.is_simulated_beam or request.is_simulated,
        plate_sha256=None if files.plate is None else _sha256(files.plate),
    )


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        msg = f"{path.name}: cannot be read ({error.strerror or error})"
        raise RecordingError(msg) from error


def _over(status: str) -> QaStateError:
    msg = f"the QA run is {status}: there is nothing to cancel"
    return QaStateError(msg, field="status", value=status, bound="running")
