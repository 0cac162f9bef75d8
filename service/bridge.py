"""The writer thread: from the engine's bounded queues to the database. Nothing in the gate's way waits for it.

Transitions are committed at once, samples in batches. When the database does not take them the writer tells the engine
to hold, stops draining, and tries again: the queues fill and the gate holds by itself too.
"""

import contextlib
import logging
import queue
import shutil
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TypeVar

from sqlalchemy import func, insert, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from engine.errors import TidegateError
from engine.frames import Measurement
from engine.live import FrameRecord, GateTransition, LoopStatus
from engine.model import MotionModel
from engine.model_file import header_text
from engine.notices import LearningNotice, NoticeKind
from engine.permits import HoldReason
from engine.provenance import ModelOrigin
from service import audit
from service.audit import SYSTEM, Event
from service.db import repository
from service.db.base import utc_text
from service.db.engine import Database
from service.db.models import ModelRow, SampleRow
from service.figures import Figures
from service.live_view import known
from service.model_store import ModelStore
from service.ports import RunningEngine
from service.session_regions import named_bytes
from service.tallies import Tallies

logger = logging.getLogger(__name__)

POLL_S = 0.02
RETRY_S = 0.2
GIVE_UP_S = 60.0
DISK_CHECK_S = 1.0
MAX_BATCH = 512
RowT = TypeVar("RowT")


@dataclass(frozen=True, slots=True, kw_only=True)
class WriterSettings:
    """How often samples are written, and how much of the disk has to stay free."""

    data_dir: Path
    sample_batch_s: float
    min_free_disk_bytes: float


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeAnchor:
    """One moment on both clocks, to write monotonic times as UTC."""

    at: datetime
    at_ns: int

    @classmethod
    def now(cls) -> "TimeAnchor":
        """Read both clocks."""
        return cls(at=datetime.now(UTC), at_ns=time.monotonic_ns())

    def utc(self, at_ns: int) -> datetime:
        """Convert host monotonic time [ns]."""
        return self.at + timedelta(microseconds=(at_ns - self.at_ns) / 1000)


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
        settings: WriterSettings,
        tallies: Tallies,
        on_over: Callable[[], None],
    ) -> None:
        super().__init__(name="tidegate-writer", daemon=True)
        self._session_id = session_id
        self._engine = engine
        self._origin = origin
        self._database = database
        self._models = models
        self._settings = settings
        self._tallies = tallies
        self._on_over = on_over
        self._anchor = TimeAnchor.now()
        self._transitions: list[GateTransition] = []
        self._samples: list[FrameRecord] = []
        self._notices: list[LearningNotice] = []
        self._written_at_s = time.monotonic()
        self._disk_checked_at_s = 0.0
        self._model: MotionModel | None = None
        self._stopped_by: str | None = None
        self._is_complete = False
        self.active_model_id: str | None = None
        self.figures = Figures()

    def stopping(self, operator: str) -> None:
        """Remember who ended the session, for its last row."""
        self._stopped_by = operator

    @property
    def is_stopping(self) -> bool:
        """Whether somebody asked to end the session."""
        return self._stopped_by is not None

    def run(self) -> None:
        """Write until the engine is over."""
        try:
            is_over = False
            while not (is_over and self._is_drained()):
                is_over = self._engine.status.is_over  # read before draining: what comes last is still taken
                self._collect()
                self._try(self._write_due, is_last=is_over)
                self._try(self._keep_model, is_last=is_over)
                self._check_disk()
            self._is_complete = True
        finally:
            if not self._is_complete:
                self._give_up()
            self._try(self._close, is_last=True)
            self._on_over()

    def _give_up(self) -> None:
        """Stop the engine because this thread broke, and keep at least the transitions."""
        self._engine.report_fault(HoldReason.AUDIT_BEHIND, "the writer thread broke")
        self._engine.stop()
        self._samples.clear()
        _drain(self._engine.transitions, self._transitions)
        self._try(self._write_due, is_last=True)

    def _is_drained(self) -> bool:
        engine = self._engine
        return engine.transitions.empty() and engine.samples.empty() and engine.notices.empty()

    def _collect(self) -> None:
        """Take what waits; leave it in the queues while earlier rows are still unwritten."""
        if len(self._transitions) < MAX_BATCH:
            with contextlib.suppress(queue.Empty):
                self._transitions.append(self._engine.transitions.get(timeout=POLL_S))
            _drain(self._engine.transitions, self._transitions)
        _drain(self._engine.samples, self._samples)
        _drain(self._engine.notices, self._notices)

    def _try(self, write: Callable[[], None], *, is_last: bool) -> None:
        """Do a piece of writing; on failure hold the beam and try until it works, or give up after the end."""
        give_up_at_s = time.monotonic() + GIVE_UP_S
        while True:
            try:
                write()
            except (SQLAlchemyError, OSError) as error:
                self._engine.report_fault(HoldReason.AUDIT_BEHIND, "the database does not take what is written")
                logger.warning("the database does not take session %s: %s", self._session_id, type(error).__name__)
            else:
                return
            is_over = is_last or self._engine.status.is_over
            if is_over and time.monotonic() > give_up_at_s:
                logger.critical("gave up writing session %s", self._session_id)
                return
            time.sleep(RETRY_S)

    def _write_due(self) -> None:
        now_s = time.monotonic()
        is_due = now_s - self._written_at_s >= self._settings.sample_batch_s or len(self._samples) >= MAX_BATCH
        is_told = bool(self._transitions or self._notices)
        if not is_told and not (self._samples and (is_due or self._engine.status.is_over)):
            return
        with self._database.write() as db:
            for transition in self._transitions:
                audit.append(db, transition_event(self._session_id, transition), self._anchor.utc(transition.at_ns))
            for notice in self._notices:
                audit.append(db, notice_event(self._session_id, notice))
            if self._samples:
                db.execute(insert(SampleRow), [sample_values(self._session_id, record) for record in self._samples])
        for record in self._samples:
            self.figures.add(record)
            self._tallies.frame(record)
        for transition in self._transitions:
            self._tallies.transition(transition)
        self.figures.transitions += len(self._transitions)
        self._transitions.clear()
        self._samples.clear()
        self._notices.clear()
        self._written_at_s = now_s

    def _keep_model(self) -> None:
        """Store a model the engine has taken up since the last look."""
        model = self._engine.model
        if model is None or model is self._model:
            return
        kept = model.from_origin(replace(self._origin, created_at=utc_text(datetime.now(UTC))))
        try:
            sha256 = self._models.save(kept)
        except TidegateError as error:
            logger.warning("a model of session %s could not be kept: %s", self._session_id, error.code)
            return
        with self._database.write() as db:
            self.active_model_id = _record_model(db, self._session_id, sha256, kept)
        self._model = model

    def _check_disk(self) -> None:
        """Look whether there is room, and whether the database is still where it was; tell trouble while it lasts.

        While there is some it is looked and told at every turn: told once a second, an acknowledgement in between would
        leave the gate a second without it.
        """
        now_s = time.monotonic()
        if now_s - self._disk_checked_at_s < DISK_CHECK_S:
            return
        trouble = self._database_trouble()
        if trouble is not None:
            self._engine.report_fault(HoldReason.AUDIT_BEHIND, trouble)
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
        status, detail = self._ending()
        with self._database.write() as db:
            row = repository.session_row(db, self._session_id)
            row.status, row.status_detail, row.ended_at = status, detail, datetime.now(UTC)
            figures = repository.summary(db, self._session_id)
            row.summary = figures.model_dump_json()
            event = Event(
                actor=self._stopped_by or SYSTEM,
                action="session.close",
                outcome="failed" if status == "failed" else "done",
                session_id=self._session_id,
                detail={"status": status, "detail": detail, "summary": figures.model_dump()},
            )
            audit.append(db, event)

    def _ending(self) -> tuple[str, str]:
        if not self._is_complete:
            return "failed", "the session could not be written down; see the service's log"
        if self._engine.status is LoopStatus.FAILED:
            return "failed", self._engine.error or "the engine failed"
        if self._stopped_by is not None:
            return "stopped", f"stopped by {self._stopped_by}"
        return "ended", self._engine.error or "the recording is over"


def _drain(source: "queue.Queue[RowT]", target: list[RowT]) -> None:
    while len(target) < MAX_BATCH:
        try:
            target.append(source.get_nowait())
        except queue.Empty:
            return


def transition_event(session_id: str, transition: GateTransition) -> Event:
    """Put a gate transition into the audit's words."""
    return Event(
        actor=transition.operator or SYSTEM,
        action=repository.TRANSITION,
        session_id=session_id,
        detail={
            "from_state": transition.from_state.value,
            "to_state": transition.to_state.value,
            "reason": None if transition.reason is None else transition.reason.value,
            "operator": transition.operator,
            "detail": transition.detail,
            "frame_index": transition.frame_index,
            "captured_us": transition.captured_us,
            "received_ns": transition.received_ns,
            "decided_ns": transition.decided_ns,
            "asserted_ns": transition.asserted_ns,
            "captured_ns": transition.captured_ns,
            "latency_ms": transition.latency_ms,
        },
    )


def notice_event(session_id: str, notice: LearningNotice) -> Event:
    """Put what the learning has to tell into the audit's words."""
    is_refusal = notice.kind is NoticeKind.REFUSED
    return Event(
        actor=SYSTEM,
        action=f"model.{notice.kind.value}",
        outcome="refused" if is_refusal else "done",
        session_id=session_id,
        detail={**notice.figures, "detail": notice.detail, "timestamp_us": notice.timestamp_us},
    )


def sample_values(session_id: str, record: FrameRecord) -> dict[str, object]:
    """Put a frame's record into the columns of the samples table."""
    measurement = record.measurement
    motion = measurement.motion
    regions = None if motion is None else motion.regions_mm
    return {
        "session_id": session_id,
        "frame_index": measurement.frame_index,
        "timestamp_us": measurement.timestamp_us,
        "missed_frames": measurement.missed_frames,
        "state": measurement.state.value,
        "lost_reason": None if measurement.lost is None else measurement.lost.reason.value,
        "whole_mm": None if motion is None else known(motion.whole_mm),
        "thorax_mm": None if motion is None else known(motion.thorax_mm),
        "abdomen_mm": None if motion is None else known(motion.abdomen_mm),
        "volume_l": None if motion is None else known(motion.volume_l),
        "signal_mm": known(record.signal_mm),
        "residual_mm": None if motion is None else known(motion.projection.residual_mm),
        "valid_share": None if motion is None else known(motion.projection.valid_share),
        "gate": record.gate_state.value,
        "hold_reason": None if record.hold_reason is None else record.hold_reason.value,
        "line_on": record.line_on,
        "received_ns": record.received_ns,
        "decided_ns": record.decided_ns,
        "asserted_ns": record.asserted_ns,
        "region_rows": None if regions is None else regions.shape[0],
        "regions_mm": None if regions is None else regions.astype("<f4").tobytes(),
        "named_mm": named_bytes(motion),
        "captured_ns": record.captured_ns,
        "phase_percent": _phase_percent(measurement),
    }


def _phase_percent(measurement: Measurement) -> float | None:
    """Return the phase of the first signal whose breath is followed, which is the first one gated on."""
    return known(measurement.breaths[0].phase_percent) if measurement.breaths else None


def _record_model(db: Session, session_id: str, sha256: str, model: MotionModel) -> str:
    """Note that a model is measured with from now on, and keep it if it is a new one; returns its id."""
    mine = ModelRow.session_id == session_id
    row = db.scalar(select(ModelRow).where(mine, ModelRow.sha256 == sha256))
    is_new = row is None
    if row is None:
        row = ModelRow(
            id=uuid.uuid4().hex,
            session_id=session_id,
            number=(db.scalar(select(func.max(ModelRow.number)).where(mine)) or 0) + 1,
            sha256=sha256,
            spectrum=audit.canonical_json([float(share) for share in model.spectrum]),
            components=len(model.components),
            created_at=datetime.now(UTC),
            provenance=header_text(model),
        )
        db.add(row)
    detail = {"model_id": row.id, "number": row.number, "sha256": sha256, "is_new": is_new}
    event = Event(actor=SYSTEM, action="model.in_use", session_id=session_id, detail=detail)
    audit.append(db, event)
    return row.id
