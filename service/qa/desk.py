"""QA runs under way: begun on a thread of their own, one at a time, never beside a session; cancelled line first."""

import hashlib
import threading
import uuid
from pathlib import Path

from sqlalchemy.orm import Session

from engine.calibration import Calibration, parse_calibration
from engine.errors import RecordingError
from engine.qa.results import QaKind
from service import audit
from service.audit import Event
from service.audit_log import AuditLog
from service.db import repository
from service.db.engine import ANSWER_TIMEOUT_S, BUSY_TIMEOUT_S, Database
from service.errors import BoundError, QaStateError
from service.idempotency import CallersKey, InProgress, earlier_answer, keep_answer
from service.ports import Kept
from service.qa import records, schemas, views
from service.qa.jobs import Handle, QaJob, carry_out
from service.qa.ports import QaFiles, QaRig
from service.qa.records import QaBegin, QaOutcome
from service.qa.under_way import Current, UnderWay
from service.recordings import find_recording
from service.room import Room
from service.settings import Settings
from service.uncalibrated import check_still_allowed

CANCEL = "qa.cancel"
JOIN_S = 10.0


class QaDesk:
    """Begins and cancels runs."""

    def __init__(
        self,
        *,
        database: Database,
        log: AuditLog,
        settings: Settings,
        room: Room,
        rig: QaRig,
        under_way: UnderWay,
    ) -> None:
        self._database = database
        self._log = log
        # By connections that no read has, as what takes a session's permission away.
        self._undelayed_database = database.twin(busy_timeout_s=BUSY_TIMEOUT_S, answer_timeout_s=ANSWER_TIMEOUT_S)
        self._undelayed_log = AuditLog(self._undelayed_database)
        self._settings = settings
        self._room = room
        self._rig = rig
        self._under_way = under_way
        self._thread: threading.Thread | None = None
        self._in_progress = InProgress()

    def start(self, request: schemas.QaRunRequest, key: CallersKey | None) -> Kept[schemas.QaRun]:
        """Begin a run; refused while a session or another run has camera and line."""
        body = audit.canonical_json(request.model_dump(mode="json")).encode()
        with self._log.refusals(actor=request.operator, action=records.START), self._in_progress.only(key):
            with self._database.read() as db:
                earlier = earlier_answer(db, records.START, key, body, schemas.QaRun)
                if earlier is not None:
                    return Kept(answer=earlier, is_replay=True)
                check_word(request, self._settings)
                calibration = self._calibration(db, request)
            files = self._files(request)
            job = self._rig.job(request, files, calibration)
            run_id = uuid.uuid4().hex
            self._room.enter_qa(run_id)
            try:
                answer = self._begin(request, key, body, run_id, job, calibration, files)
            except BaseException:
                self._under_way.current = None
                self._room.leave_qa(run_id)
                raise
        return Kept(answer=answer, is_replay=False)

    def is_under_way(self, run_id: str) -> bool:
        """Whether this run goes on now, from memory."""
        return self._under_way.run_id == run_id

    def cancel(self, run_id: str, operator: str) -> schemas.QaRun:
        """Hold the line, then end the run."""
        current = self._under_way.current
        if current is None or current.run_id != run_id:
            with self._log.refusals(actor=operator, action=CANCEL, detail={"run_id": run_id}):
                raise _over(self._answer(run_id, self._database).status)
        current.handle.cancel(operator)  # before anything is looked up or written
        self._undelayed_log.write(Event(actor=operator, action=CANCEL, detail={"run_id": run_id}))
        self._join()
        return self._answer(run_id, self._undelayed_database)

    def _answer(self, run_id: str, database: Database) -> schemas.QaRun:
        with database.read() as db:
            return self._under_way.run_answer(db, records.run_row(db, run_id))

    def shut_down(self) -> None:
        """Hold the line, then end the run: on the service's way out, once nobody gets into the room any more."""
        current = self._under_way.current
        if current is not None:
            current.handle.cancel(audit.SYSTEM)
            self._join()
        self._undelayed_database.close()

    def _begin(
        self,
        request: schemas.QaRunRequest,
        key: CallersKey | None,
        body: bytes,
        run_id: str,
        job: QaJob,
        calibration: Calibration | None,
        files: QaFiles,
    ) -> schemas.QaRun:
        """Write down that the run begins, then begin it."""
        handle = Handle(job.line)
        run = qa_begin(request, self._settings, run_id=run_id, calibration=calibration, files=files)
        with self._database.write() as db:
            row = records.begin(db, run)
            answer = views.run_answer(db, row, is_under_way=True)
            keep_answer(db, records.START, key, body, answer)
            baseline = job.own_baseline or records.baseline_of(records.newest_baseline(db))
        self._under_way.current = Current(run_id=run_id, handle=handle)
        if self._room.is_closed:  # whoever closed it may have looked for a run before there was one to be seen
            handle.cancel(audit.SYSTEM)

        def work() -> None:
            carry_out(
                job, handle, bounds=run.bounds, baseline=baseline, on_end=lambda outcome: self._end(run_id, outcome)
            )

        self._thread = threading.Thread(target=work, name="qa", daemon=True)
        self._thread.start()
        return answer

    def _end(self, run_id: str, outcome: QaOutcome) -> None:
        try:
            with self._undelayed_database.write() as db:  # whoever cancels waits for it
                records.end(db, run_id, outcome)
        finally:
            self._under_way.current = None
            self._room.leave_qa(run_id)

    def _join(self) -> None:
        thread = self._thread
        if thread is not None:
            thread.join(JOIN_S)

    def _calibration(self, db: Session, request: schemas.QaRunRequest) -> Calibration | None:
        if request.calibration_id is None:
            return None
        calibration = parse_calibration(repository.calibration_row(db, request.calibration_id).document.encode())
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


def check_word(request: schemas.QaRunRequest, settings: Settings) -> None:
    """Refuse a run that would permit a real beam without the operator's word, and a simulated one in clinical mode."""
    if request.is_simulated and settings.mode == "clinical":
        bound = "left out: in clinical mode nothing is simulated"
        msg = f"simulation must be {bound}"
        raise BoundError(msg, field="simulation", value="given", bound=bound)
    if settings.has_real_beam and not request.is_simulated and not request.is_beam_safe:
        bound = (
            f"true: the drills permit the real beam ({' and '.join(settings.beam_lines)}), outside of any gating. Say "
            "so when nobody is in the room and the accelerator is made safe"
        )
        msg = f"is_beam_safe must be {bound}"
        raise BoundError(msg, field="is_beam_safe", value=request.is_beam_safe, bound=bound)


def qa_begin(
    request: schemas.QaRunRequest,
    settings: Settings,
    *,
    run_id: str,
    calibration: Calibration | None,
    files: QaFiles,
) -> QaBegin:
    """Return what is written down of a run that begins."""
    told = request.model_dump(mode="json", exclude_none=True, exclude={"operator", "kind"})
    told["beam_place"] = settings.beam_place
    if calibration is not None:
        told |= {"calibration_sha256": calibration.sha256, "camera": calibration.camera}
    return QaBegin(
        run_id=run_id,
        kind=QaKind(request.kind),
        operator=request.operator,
        request=told,
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
