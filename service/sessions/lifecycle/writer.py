"""The writer thread: from the engine's bounded queues to the database and the sample file.

The gate never waits for it. Transitions are committed at once, samples are written in batches. When the database or
the disk fails, the writer requests a hold of the engine, stops draining, and tries again: the queues fill, and the gate
holds by itself too.
"""

import contextlib
import logging
import queue
import shutil
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple, TypeVar

from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from engine.beam import BeamOff
from engine.control import GateTransition, LoopStatus, TransitionJournal
from engine.core.clock import NS_PER_MS
from engine.core.errors import TidegateError
from engine.core.gate_state import HoldReason
from engine.core.learning_status import LearningEvent
from engine.core.motion_model import ModelOrigin, MotionModel
from engine.motion import PatientMatchLimits
from service.engine_host.protocols import BodyMatch, RunningEngine
from service.sessions.lifecycle.body_comparison import EarlierBody, body_event, compare_bodies
from service.sessions.lifecycle.counters import HELD, BeamOffs, SessionCounters, beam_off_event
from service.sessions.records.audit_events import closing_event, notice_event, record_model, transition_event
from service.sessions.recovery.journal import recover_orphan
from service.storage import audit
from service.storage.audit import SYSTEM
from service.storage.database import queries
from service.storage.database.base import TimeAnchor, utc_text
from service.storage.database.engine import Database
from service.storage.database.queries import RetriedWriter
from service.storage.files.motion_models import ModelStore
from service.storage.samples.figures import Figures
from service.storage.samples.recorder import SampleRecorder
from service.storage.samples.store import Settlement

logger = logging.getLogger(__name__)

POLL_S = 0.02
RETRY_S = 0.2
SLOW_S = 0.5
"""A write that takes longer is in the log: it tells what a gate that held after `max_unwritten_ms` waited for."""
GIVE_UP_S = 60.0
DISK_CHECK_S = 1.0
ASK_S = 0.25
"""How often an idle database is tested for whether it accepts a write: without that the beam is not on."""
MAX_BATCH = 512
MOST_HURRIED_ROWS = 9000
"""Five minutes are made Parquet within a second; an hour would outlast the time that a process is given to end."""
RowT = TypeVar("RowT")


@dataclass(frozen=True, slots=True, kw_only=True)
class WriterSettings:
    """Which folder is written to, how much of its disk has to stay free, and when another body is warned of."""

    data_dir: Path
    min_free_disk_bytes: float
    match_limits: PatientMatchLimits = field(default_factory=PatientMatchLimits)


class _AuditBatch(NamedTuple):
    """Events of the engine that are committed in one transaction."""

    transitions: tuple[GateTransition, ...]
    notices: tuple[LearningEvent, ...]
    beam_offs: tuple[BeamOff, ...]


class SessionWriter(threading.Thread):
    """Writes one session down until its engine is over and its queues are empty, then closes the session."""

    def __init__(
        self,
        *,
        session_id: str,
        engine: RunningEngine,
        origin: ModelOrigin,
        database: Database,
        models: ModelStore,
        recorder: SampleRecorder,
        anchor: TimeAnchor,
        journal: TransitionJournal | None = None,
        earlier: EarlierBody | None = None,
        settings: WriterSettings,
        counters: SessionCounters,
        on_over: Callable[[], None],
    ) -> None:
        super().__init__(name="tidegate-writer", daemon=True)
        self._session_id = session_id
        self._engine = engine
        self._origin = origin
        self._database = database
        self._models = models
        self._settings = settings
        self._counters = counters
        self._on_over = on_over
        self._recorder = recorder
        self._anchor = anchor
        self._journal = journal
        self._earlier = earlier
        self._audit_write, self._model_write, self._closing_write = (RetriedWriter(database) for _ in range(3))
        self._pending: _AuditBatch | None = None
        self._transitions: list[GateTransition] = []
        self._notices: list[LearningEvent] = []
        self._offs, self._beam_offs = BeamOffs(), list[BeamOff]()
        self._disk_checked_at_s = 0.0
        self._taken_at_s = time.monotonic()
        self._model: MotionModel | None = None
        self._model_to_store: tuple[MotionModel, MotionModel] | None = None
        self._stopped_by: str | None = None
        self._is_complete = False
        self._is_hurried = False
        self._settled: Settlement | None = None
        self._recorded_model_id: str | None = None
        self._arming = engine.status.fraction_arming
        self.active_model_id: str | None = None
        self.body: BodyMatch | None = None

    @property
    def figures(self) -> Figures:
        """Counts of what has been written."""
        return self._recorder.figures

    def stopping(self, operator: str, *, is_hurried: bool = False) -> None:
        """Note who ends the session, for its last row; hurried while the service stops, to finish in time."""
        self._stopped_by = operator
        self._is_hurried = is_hurried

    @property
    def is_stopping(self) -> bool:
        """Whether an operator has stopped the session."""
        return self._stopped_by is not None

    def run(self) -> None:
        """Write until the engine is over."""
        try:
            is_over = False
            while not (is_over and self._is_drained()):
                is_over = self._engine.status.is_over  # read before draining: what comes last is still taken
                self._collect()
                self._try(self._write_audit, is_last=is_over)
                self._try(self._write_samples, is_last=is_over)
                self._try(self._store_model, is_last=is_over)
                self._try(self._store_arming, is_last=is_over)
                self._check_disk()
            self._is_complete = True
        finally:
            if not self._is_complete:
                self._give_up()
            self._try(self._close, is_last=True)
            self._on_over()

    def _give_up(self) -> None:
        """Stop the engine because this thread failed, and store at least the transitions."""
        self._engine.report_fault(HoldReason.AUDIT_BEHIND, "the writer thread broke")
        self._engine.stop()
        self._recorder.waiting.clear()
        _drain(self._engine.transitions, self._transitions)
        self._try(self._write_audit, is_last=True)

    def _is_drained(self) -> bool:
        return self._engine.transitions.empty() and self._engine.samples.empty() and self._engine.notices.empty()

    def _collect(self) -> None:
        """Take what is in the queues; leave it there while earlier rows are not written."""
        if len(self._transitions) < MAX_BATCH:
            with contextlib.suppress(queue.Empty):
                self._transitions.append(self._engine.transitions.get(timeout=POLL_S))
            _drain(self._engine.transitions, self._transitions)
        _drain(self._engine.samples, self._recorder.waiting)
        _drain(self._engine.notices, self._notices)
        if len(self._beam_offs) < MAX_BATCH:
            self._beam_offs += self._offs.take(self._engine.status.view)

    def _try(self, write: Callable[[], None], *, is_last: bool) -> None:
        """Write; on failure hold the beam and retry until it succeeds, or give up after the session's end."""
        give_up_at_s = time.monotonic() + GIVE_UP_S
        while True:
            began_s = time.monotonic()
            try:
                write()
            except SQLAlchemyError as error:
                self._engine.report_fault(HoldReason.AUDIT_BEHIND, "the database does not take what is written")
                logger.warning("the database does not take session %s: %s", self._session_id, type(error).__name__)
            except OSError as error:
                self._engine.report_fault(HoldReason.RECORDER_BEHIND, "the disk does not take what was measured")
                logger.warning("the disk does not take session %s: %s", self._session_id, error.strerror)
            else:
                if (took_s := time.monotonic() - began_s) >= SLOW_S:
                    logger.warning("session %s: %s took %.1f s", self._session_id, write.__name__.strip("_"), took_s)
                return
            is_over = is_last or self._engine.status.is_over
            if is_over and time.monotonic() > give_up_at_s:
                logger.critical("gave up writing session %s", self._session_id)
                return
            time.sleep(RETRY_S)

    def _write_audit(self) -> None:
        """Commit transitions and training events at once; test the database when nothing was committed for a while."""
        while self._transitions or self._notices or self._beam_offs:
            self._write_batch()
        if time.monotonic() - self._taken_at_s >= ASK_S:
            with self._database.write() as db:
                db.connection()  # begins a transaction, with the lock that a row needs
            self._taken_at_s = time.monotonic()

    def _write_batch(self) -> None:
        """Commit what is waiting; a batch that may be committed already is retried unchanged, with nothing added."""
        batch = self._pending = self._pending or _AuditBatch(
            tuple(self._transitions), tuple(self._notices), tuple(self._beam_offs)
        )
        self._audit_write.write(batch, lambda db: self._append(db, batch))
        self._pending = None
        self._taken_at_s = time.monotonic()
        self._confirm(batch.transitions)
        for transition in batch.transitions:
            self._counters.transition(transition)
        self.figures.transitions += len(batch.transitions)
        held = [one.reason for one in batch.transitions if one.to_state in HELD and one.reason is not None]
        self.figures.holds.update(str(reason.value) for reason in held)
        self.figures.beam_offs_ms += [off.off_ms for off in batch.beam_offs]
        del self._transitions[: len(batch.transitions)], self._notices[: len(batch.notices)]
        del self._beam_offs[: len(batch.beam_offs)]

    def _append(self, db: Session, batch: _AuditBatch) -> None:
        for transition in batch.transitions:
            audit.append(db, transition_event(self._session_id, transition), self._anchor.utc(transition.at_ns))
        for notice in batch.notices:
            audit.append(db, notice_event(self._session_id, notice))
            if notice.first is not None:
                queries.session_row(db, self._session_id).first_reference = notice.first.to_json()
        for off in batch.beam_offs:
            off_ns = off.ended_ns + round(off.off_ms * NS_PER_MS)
            audit.append(db, beam_off_event(self._session_id, off), self._anchor.utc(off_ns))

    def _confirm(self, transitions: Iterable[GateTransition]) -> None:
        """Acknowledge committed transitions to the journal, so that their slots can be used again."""
        newest = max((transition.number or 0 for transition in transitions), default=0)
        if self._journal is not None:
            self._journal.acknowledge(newest)

    def _write_samples(self) -> None:
        for record in self._recorder.write_due(is_last=self._engine.status.is_over):
            self._counters.frame(record)

    def _store_arming(self) -> None:
        """Store what the fraction was armed with, if this session has changed it since the last call."""
        arming = self._engine.status.fraction_arming
        if arming is None or arming == self._arming:
            return
        with self._database.write() as db:
            queries.session_row(db, self._session_id).fraction_arming = arming.to_json()
        self._arming = arming

    def _store_model(self) -> None:
        """Store the model in use, if the engine has changed it since the last call."""
        model = self._engine.status.learning.model
        if model is None or model is self._model:
            return
        if self._model_to_store is None or self._model_to_store[0] is not model:  # a retry stores the same file
            origin = replace(self._origin, created_at=utc_text(datetime.now(UTC)))
            self._model_to_store = (model, model.from_origin(origin))
        stored = self._model_to_store[1]
        try:
            sha256 = self._models.save(stored)
        except TidegateError as error:
            logger.warning("a model of session %s could not be kept: %s", self._session_id, error.code)
            return

        body = self._compared(model)

        def record(db: Session) -> None:
            self._recorded_model_id = record_model(db, self._session_id, sha256, stored)
            if body is not None:
                audit.append(db, body_event(self._session_id, body))

        self._model_write.write(model, record)
        self._model, self.body = model, body or self.body
        self.active_model_id = self._recorded_model_id  # last: with the model, readers see its comparison

    def _compared(self, model: MotionModel) -> BodyMatch | None:
        """Compare the first model that this session has learned with the patient's earlier session."""
        is_learned_here = model.provenance.origin is None
        if self._earlier is None or self.body is not None or not is_learned_here:
            return None
        return compare_bodies(self._earlier, model, self._settings.match_limits)

    def _check_disk(self) -> None:
        """Check disk space, the sample file and the database; report a fault for as long as one is found.

        A fault is checked and reported at every turn: reported once a second only, an acknowledgement in between would
        leave the gate without the fault for up to a second.
        """
        now_s = time.monotonic()
        if now_s - self._disk_checked_at_s < DISK_CHECK_S:
            return
        trouble = self._database_trouble()
        if trouble is not None:
            self._engine.report_fault(HoldReason.AUDIT_BEHIND, trouble)
        elif not self._recorder.is_there:
            self._engine.report_fault(HoldReason.RECORDER_BEHIND, "the sample file was taken away or replaced")
        elif shutil.disk_usage(self._settings.data_dir).free < self._settings.min_free_disk_bytes:
            self._engine.report_fault(HoldReason.DISK_LOW, "the data folder's disk is almost full")
        else:
            self._disk_checked_at_s = now_s

    def _database_trouble(self) -> str | None:
        try:
            return self._database.trouble()
        except SQLAlchemyError:
            return "the database does not answer"

    def _close(self) -> None:
        """Make the final sample file, record the end, and only then remove the stream."""
        status, detail = self._ending()
        settled = self._settled = self._settled or self._settle()
        samples = self._recorder.leave_open() if settled is None else settled.audit_detail
        evidence = self._engine.evidence()
        if self._journal is not None and self._journal.is_orphaned:
            recover_orphan(self._database, self._journal.path)

        def end(db: Session) -> None:
            row = queries.session_row(db, self._session_id)
            row.status, row.status_detail, row.ended_at = status, detail, datetime.now(UTC)
            self.figures.transitions = queries.transition_count(db, self._session_id)
            self.figures.holds = queries.hold_counts(db, self._session_id)
            figures = self.figures.summary()
            row.summary = figures.model_dump_json()
            event = closing_event(row, figures, samples, actor=self._stopped_by or SYSTEM)
            audit.append(db, replace(event, detail={**event.detail, **evidence}))

        self._closing_write.write(self, end)
        if self._journal is not None:
            self._journal.close()
        if settled is not None:
            with contextlib.suppress(OSError):  # the next start removes it
                self._recorder.forget_stream()

    def _settle(self) -> Settlement | None:
        """Make the Parquet file; return None where that fails: the stream stays, and the next start makes the file."""
        if self._is_hurried and self._recorder.rows > MOST_HURRIED_ROWS:
            return None
        try:
            return self._recorder.settle()
        except OSError as error:
            logger.warning("session %s stays in its stream: %s", self._session_id, error)
            return None

    def _ending(self) -> tuple[str, str]:
        if not self._is_complete:
            return "failed", "the session could not be written down; see the service's log"
        if self._engine.status.run_state is LoopStatus.FAILED:
            return "failed", self._engine.status.error or "the engine failed"
        if self._stopped_by is not None:
            return "stopped", f"stopped by {self._stopped_by}"
        return "ended", self._engine.status.error or "the recording is over"


def _drain(source: "queue.Queue[RowT]", target: list[RowT]) -> None:
    while len(target) < MAX_BATCH:
        try:
            target.append(source.get_nowait())
        except queue.Empty:
            return
