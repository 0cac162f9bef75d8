"""Background work of the audit while the service runs: anchoring, clock check and the log file."""

import logging
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta

from sqlalchemy import select
from sqlalchemy.exc import SQLAlchemyError

from engine.core.clock import NS_PER_MS, NS_PER_S, Clock, MonotonicClock
from service.core.periodic import PeriodicWorker
from service.core.settings.groups import AuditSettings
from service.storage.audit import check as start
from service.storage.audit.anchors import AnchorFile, AnchorKind
from service.storage.audit.chain import SYSTEM, Event
from service.storage.audit.check import check_tail, clock_event
from service.storage.audit.log_file import AuditLogFile
from service.storage.audit.verification import head_sequence
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow

MARKS: dict[str, AnchorKind] = {
    "service.start": "start",
    "service.stop": "stop",
    "session.start": "session",
    "session.close": "session",
}
"""Actions after which the head is anchored at once, with the kind of the anchor."""
BATCH_ROWS = 5000
NO_ANSWER_S = 10
FAILED = "audit.anchors_failed"
RESUMED = "audit.anchors_resumed"
NS_PER_US = 1000
logger = logging.getLogger(__name__)
INTERVAL_S = 1.0
ANSWER_S = 5.0
"""Longest wait for the anchor file at start and stop [s]; it may be on a share that hangs."""
BROKEN = "audit.broken"
MB = 1_000_000
ANCHOR_INTERVAL_S = 60.0
"""Longest interval between anchors while rows are added."""
CLOCK_JUMP_MS = 500.0
"""Change of the wall clock against the monotonic one beyond which the audit records it as set."""


# Appends the newest head of the chain to the anchor file: at start and stop, with sessions, and periodically.
#
# It reads the audit table in its own thread, so that writers of rows never wait for it, even if the network share of
# the anchor file hangs. A file that cannot be written is audited and reported by readiness; it does not hold the
# beam.
class AnchorWriter:
    """Reads new audit rows and anchors the head when it is due.

    Parameters
    ----------
    interval_s
        Shortest time between two periodic anchors [s].
    after
        Sequence of the newest row that needs no anchor.
    """

    def __init__(
        self,
        *,
        database: Database,
        file: AnchorFile,
        clock: Clock,
        interval_s: float,
        write: Callable[[Event], None],
        after: int = 0,
    ) -> None:
        self._database = database
        self._file = file
        self._clock = clock
        self._interval_ns = round(interval_s * NS_PER_S)
        self._write = write
        self._newest = after
        self._newest_hash: str | None = None
        self._anchored = after
        self._tried_at_ns: int | None = None
        self._pending_kind: AnchorKind | None = None
        self._failed: str | None = None
        self._writing_since_ns: int | None = None

    @property
    def trouble(self) -> str | None:
        """Why heads are not anchored: a write error, or no answer for `NO_ANSWER_S`; None while all is well."""
        since_ns = self._writing_since_ns
        waited_s = 0 if since_ns is None else (self._clock.now_ns() - since_ns) // NS_PER_S
        if waited_s >= NO_ANSWER_S:
            return f"the audit's heads cannot be kept: {self._file.path} has not answered for {waited_s} s"
        return self._failed

    def update(self) -> None:
        """Read new rows and anchor the head if it is due; raise SQLAlchemyError if the database fails."""
        self._read_new_rows()
        if self._newest_hash is None or self._newest == self._anchored:
            return
        now_ns = self._clock.now_ns()
        is_due = self._tried_at_ns is None or now_ns - self._tried_at_ns >= self._interval_ns
        # Marked rows are anchored at once, except after a failed write: then at the interval.
        if is_due or (self._pending_kind is not None and self._failed is None):
            self._tried_at_ns = now_ns
            self._write_anchor(self._pending_kind or "time", self._newest_hash)

    def end(self) -> None:
        """Anchor the newest head at shutdown, even if the interval has not passed."""
        self._tried_at_ns = None
        self.update()

    def _read_new_rows(self) -> None:
        """Read the rows added since the last call, in batches."""
        query = select(AuditRow.sequence, AuditRow.hash, AuditRow.action).order_by(AuditRow.sequence).limit(BATCH_ROWS)
        while True:
            with self._database.read() as db:
                found = db.execute(query.where(AuditRow.sequence > self._newest)).all()
            for sequence, row_hash, action in found:
                self._newest, self._newest_hash = sequence, row_hash
                self._pending_kind = MARKS.get(action, self._pending_kind)
            if len(found) < BATCH_ROWS:
                return

    def _write_anchor(self, kind: AnchorKind, head_hash: str) -> None:
        sequence = self._newest
        self._writing_since_ns = self._clock.now_ns()
        try:
            self._file.append(kind, sequence=sequence, head_hash=head_hash)
        except OSError as error:
            self._report(f"the audit's heads cannot be kept in {self._file.path}: {error.strerror or error}")
            return
        finally:
            self._writing_since_ns = None
        self._anchored, self._pending_kind = sequence, None
        if self._failed is not None:
            self._failed = None
            self._write(Event(actor=SYSTEM, action=RESUMED, detail={"sequence": sequence}))

    def _report(self, trouble: str) -> None:
        is_new, self._failed = self._failed is None, trouble
        if is_new:
            logger.error("%s", trouble)
            self._write(Event(actor=SYSTEM, action=FAILED, outcome="failed", detail={"detail": trouble}))


# Detects steps of the system clock by comparison with the monotonic clock, since audit times depend on it.
#
# Both clocks are slewed together, so a slow correction by a time server is not detected; a step by hand or by a time
# server, and a suspended machine, are.
class ClockWatch:
    """Compares both clocks with their values at the start or at the last step; ``jump_ms`` is the tolerance [ms]."""

    def __init__(
        self, *, clock: Clock, now: Callable[[], datetime], jump_ms: float, write: Callable[[Event], None]
    ) -> None:
        self._clock = clock
        self._now = now
        self._jump_ns = round(jump_ms * NS_PER_MS)
        self._write = write
        self._at, self._at_ns = now(), clock.now_ns()

    def check(self) -> None:
        """Compare the clocks; audit a step once and take the new time as reference."""
        at, at_ns = self._now(), self._clock.now_ns()
        expected = self._at + timedelta(microseconds=(at_ns - self._at_ns) / NS_PER_US)
        if abs((at - expected) / timedelta(microseconds=1)) * NS_PER_US <= self._jump_ns:
            return
        # Written first: if the write fails, the next check detects the step again.
        self._write(clock_event(before=expected, after=at, seen="while the service ran"))
        self._at, self._at_ns = at, at_ns


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
            went_back = start.clock_went_back(db, self._now(), CLOCK_JUMP_MS / 1000)
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
            interval_s=ANCHOR_INTERVAL_S,
            write=self._write,
            after=seen,
        )
        watch = ClockWatch(clock=self._clock, now=self._now, jump_ms=CLOCK_JUMP_MS, write=self._write)
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
