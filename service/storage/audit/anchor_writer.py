"""Appends the newest head of the chain to the anchor file: at start and stop, with sessions, and periodically.

It reads the audit table in its own thread, so that writers of rows never wait for it, even if the network share of the
anchor file hangs. A file that cannot be written is audited and reported by readiness; it does not hold the beam.
"""

import logging
from collections.abc import Callable

from sqlalchemy import select

from engine.core.clock import NS_PER_S, Clock
from service.storage.audit.anchors import AnchorFile, AnchorKind
from service.storage.audit.chain import SYSTEM, Event
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow

logger = logging.getLogger(__name__)

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
