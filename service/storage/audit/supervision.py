"""Background work of the audit while the service runs: anchoring, clock check and the log file."""

import logging
import threading
from collections.abc import Callable
from datetime import UTC, datetime

from sqlalchemy.exc import SQLAlchemyError

from engine.core.clock import Clock, MonotonicClock
from service.core.periodic import PeriodicWorker
from service.core.settings.audit import AuditSettings
from service.storage.audit import startup as start
from service.storage.audit.anchor_writer import AnchorWriter
from service.storage.audit.anchors import AnchorFile
from service.storage.audit.chain import SYSTEM, Event
from service.storage.audit.check import check_tail
from service.storage.audit.clock_watch import ClockWatch
from service.storage.audit.log_file import AuditLogFile
from service.storage.audit.verification import head_sequence
from service.storage.database.engine import Database

logger = logging.getLogger(__name__)

INTERVAL_S = 1.0
ANSWER_S = 5.0
"""Longest wait for the anchor file at start and stop [s]; it may be on a share that hangs."""
BROKEN = "audit.broken"
MB = 1_000_000


class AuditSupervision:
    """Starts and stops the audit's background work, and audits the start of the service."""

    def __init__(
        self,
        *,
        database: Database,
        settings: AuditSettings,
        write: Callable[[Event], None],
        clock: Clock | None = None,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._database = database
        self._settings = settings
        self._write = write
        self._clock = clock or MonotonicClock()
        self._now = now
        self._file = AnchorFile(settings.anchor_file)
        self._broken: str | None = None
        self._anchor_writer: AnchorWriter | None = None
        self._log_file: AuditLogFile | None = None
        self._workers: list[PeriodicWorker] = []

    @property
    def troubles(self) -> list[str]:
        """Sentences about what is wrong, for readiness; none of them holds the beam."""
        writers = [one.trouble for one in (self._anchor_writer, self._log_file) if one is not None]
        found = [self._broken, *writers, *(worker.trouble for worker in self._workers)]
        return [trouble for trouble in found if trouble is not None]

    @property
    def passed_on(self) -> int | None:
        """Sequence of the newest row in the log file; None without one."""
        return None if self._log_file is None else self._log_file.written

    def start(self, detail: dict[str, object]) -> None:
        """Verify the newest rows, audit the start with changed settings, and start the background threads."""
        with self._database.read() as db:
            before = start.last_start(db)
            went_back = start.clock_went_back(db, self._now(), self._settings.audit_clock_jump_ms / 1000)
            seen = head_sequence(db)
        settings = start.redacted_settings(self._settings)
        anchors = self._with_timeout(self._check)
        self._write(
            Event(
                actor=SYSTEM,
                action=start.START,
                detail={
                    **detail,
                    "settings": settings,
                    "settings_sha256": start.settings_sha256(settings),
                    "anchors": anchors,
                },
            )
        )
        changed = start.changes(before, settings)
        self._report(went_back, changed)
        self._start_workers(seen)

    def close(self) -> None:
        """Stop the background threads; anchor the last head and write the last rows first."""
        for worker in self._workers:
            worker.stop(ANSWER_S)

    def _check(self) -> dict[str, object] | None:
        self._broken = check_tail(self._database, self._file)
        reached = self._file.reached()
        if reached is None:
            return None
        return {"size_bytes": reached.size_bytes, "line_sha256": reached.line_sha256}

    def _with_timeout(self, check: Callable[[], dict[str, object] | None]) -> object:
        """Run a check in a thread; return its result, or a sentence if it fails or times out."""
        found: list[object] = []

        def run() -> None:
            try:
                found.append(check())
            except OSError as error:
                found.append(f"the anchor file cannot be read: {error.strerror or error}")
            except SQLAlchemyError as error:
                found.append(f"the database did not answer ({type(error).__name__})")

        thread = threading.Thread(target=run, name="tidegate-audit-check", daemon=True)
        thread.start()
        thread.join(ANSWER_S)
        return found[0] if found else f"the anchor file has not answered for {ANSWER_S:g} s"

    def _report(self, *events: Event | None) -> None:
        for event in events:
            if event is not None:
                self._write(event)
        if self._broken is not None:
            logger.critical("the audit log is broken: %s; see `tidegate audit verify`", self._broken)
            self._write(Event(actor=SYSTEM, action=BROKEN, outcome="failed", detail={"detail": self._broken}))

    def _start_workers(self, seen: int) -> None:
        self._anchor_writer = AnchorWriter(
            database=self._database,
            file=self._file,
            clock=self._clock,
            interval_s=self._settings.audit_anchor_interval_s,
            write=self._write,
            after=seen,
        )
        watch = ClockWatch(
            clock=self._clock, now=self._now, jump_ms=self._settings.audit_clock_jump_ms, write=self._write
        )
        self._workers = [
            _worker("tidegate-anchors", self._anchor_writer.update, self._anchor_writer.end),
            _worker("tidegate-clock", watch.check),
        ]
        if self._settings.audit_log_dir is not None:
            self._log_file = AuditLogFile(
                database=self._database,
                folder=self._settings.audit_log_dir,
                max_bytes=self._settings.audit_log_max_mb * MB,
                kept_files=self._settings.audit_log_files,
                write=self._write,
                after=seen,
                with_patients=self._settings.audit_log_patients,
            )
            self._workers.append(_worker("tidegate-audit-log", self._log_file.update, self._log_file.update))
        for worker in self._workers:
            worker.start()


def _worker(name: str, work: Callable[[], None], last: Callable[[], None] | None = None) -> PeriodicWorker:
    """Make a worker that runs every second; database and file errors do not end it."""
    return PeriodicWorker(name, work, interval_s=INTERVAL_S, last=last, recoverable=(SQLAlchemyError, OSError))
