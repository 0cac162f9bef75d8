"""Keeps the newest head in the file outside the database: at start and stop, with sessions, and while rows come.

It follows the table like any other reader, in a thread of its own: whoever writes rows never waits for it, and a share
that hangs holds nothing up. A file that cannot be written is told, and no beam is held for it.
"""

import logging
from collections.abc import Callable

from sqlalchemy import select

from engine.clock import NS_PER_S, Clock
from service.audit.anchors import AnchorFile, AnchorKind
from service.audit.chain import SYSTEM, Event
from service.db.engine import Database
from service.db.models import AuditRow

logger = logging.getLogger(__name__)

MARKS: dict[str, AnchorKind] = {
    "service.start": "start",
    "service.stop": "stop",
    "session.start": "session",
    "session.close": "session",
}
"""Rows after which a head is kept at once."""
LOOK_ROWS = 5000
SILENT_S = 10
FAILED = "audit.anchors_failed"
RESUMED = "audit.anchors_resumed"


class AnchorKeeper:
    """Looks at what was added, and keeps heads."""

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
        self._seen = after
        self._hash: str | None = None
        self._kept = after
        self._tried_at_ns: int | None = None
        self._wanted: AnchorKind | None = None
        self._failed: str | None = None
        self._asking_since_ns: int | None = None

    @property
    def trouble(self) -> str | None:
        """Say that heads are not kept: refused, or a share that does not answer at all."""
        since_ns = self._asking_since_ns
        silent_s = 0 if since_ns is None else (self._clock.now_ns() - since_ns) // NS_PER_S
        if silent_s >= SILENT_S:
            return f"the audit's heads cannot be kept: {self._file.path} has not answered for {silent_s} s"
        return self._failed

    def look(self) -> None:
        """Take in what was added, and keep the head where it is due."""
        self._take_in()
        if self._hash is None or self._seen == self._kept:
            return
        now_ns = self._clock.now_ns()
        is_due = self._tried_at_ns is None or now_ns - self._tried_at_ns >= self._interval_ns
        # A mark is kept at once; but a share that is away is asked no more often than one that is there.
        if is_due or (self._wanted is not None and self._failed is None):
            self._tried_at_ns = now_ns
            self._keep(self._wanted or "time", self._hash)

    def end(self) -> None:
        """Keep the last head there is."""
        self._tried_at_ns = None
        self.look()

    def _take_in(self) -> None:
        """Read what was added since the last look, so many rows at a time."""
        query = select(AuditRow.sequence, AuditRow.hash, AuditRow.action).order_by(AuditRow.sequence).limit(LOOK_ROWS)
        while True:
            with self._database.read() as db:
                found = db.execute(query.where(AuditRow.sequence > self._seen)).all()
            for sequence, row_hash, action in found:
                self._seen, self._hash = sequence, row_hash
                self._wanted = MARKS.get(action, self._wanted)
            if len(found) < LOOK_ROWS:
                return

    def _keep(self, kind: AnchorKind, head_hash: str) -> None:
        sequence = self._seen
        self._asking_since_ns = self._clock.now_ns()
        try:
            self._file.append(kind, sequence=sequence, head_hash=head_hash)
        except OSError as error:
            self._tell(f"the audit's heads cannot be kept in {self._file.path}: {error.strerror or error}")
            return
        finally:
            self._asking_since_ns = None
        self._kept, self._wanted = sequence, None
        if self._failed is not None:
            self._failed = None
            self._write(Event(actor=SYSTEM, action=RESUMED, detail={"sequence": sequence}))

    def _tell(self, trouble: str) -> None:
        is_new, self._failed = self._failed is None, trouble
        if is_new:
            logger.error("%s", trouble)
            self._write(Event(actor=SYSTEM, action=FAILED, outcome="failed", detail={"detail": trouble}))
