"""ETags of sessions: each is made from the number of the newest decision about the session in the audit.

A running session's figures change with every frame; what a person or a machine decided does not. Each decision is a row
of the audit, so that the newest row's number says whether anything was decided since it was read. A call that takes
permission away is executed first and recorded after, so `service.sessions.records.withdrawals` counts it before it is
executed.

Counts of the commands that took permission away from a session: holds, disarms and stops, kept in memory.

Their audit rows are written after the command, too late for the session's ETag; these counts change before the engine
receives the command, and again once it is executed. They never decrease while the process runs and start at 0 with it.
"""

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from service.core.conditional import Precondition, etag_of
from service.core.errors import EngineTimeoutError
from service.storage.database import queries
from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow

DECISIONS = (
    "session.create",
    "session.simulation",
    "session.start",
    "session.reference",
    "session.position_check",
    "session.countersign",
    "session.arm",
    "session.disarm",
    "session.hold",
    "session.release",
    "session.acknowledge",
    "session.baseline_correction",
    "session.window",
    "session.stop",
    "session.close",
    "model.retrain",
    "model.apply",
    "model.activate",
)
LONGEST_WAIT_S = 2.0


class Withdrawals:
    """Number of holds, disarms and stops per session; changes the ETag."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def count(self, session_id: str) -> int:
        """Return the count; a changed count makes an earlier ETag of the session invalid."""
        return self._counts[session_id]

    @contextmanager
    def one(self, session_id: str) -> Iterator[None]:
        """Count before and after the body: an ETag read before or during it does not match afterwards."""
        self._increment(session_id)
        try:
            yield
        finally:
            self._increment(session_id)

    def _increment(self, session_id: str) -> None:
        with self._lock:
            self._counts[session_id] += 1


class SessionRevisions:
    """Returns ETags of sessions, and executes conditional calls one at a time."""

    def __init__(self, database: Database, withdrawals: Withdrawals) -> None:
        self._database = database
        self._withdrawals = withdrawals
        self._turn = threading.Lock()

    def etag(self, session_id: str) -> str:
        """Return a session's ETag; raise NotFoundError."""
        with self._database.read() as db:
            status = queries.session_row(db, session_id).status
            newest = _newest_decision(db, session_id)
        return etag_of("session", session_id, status, newest, self._withdrawals.count(session_id))

    @contextmanager
    def only_if(self, session_id: str, wanted: Precondition) -> Iterator[None]:
        """Execute the body if the session's ETag still matches; raise PreconditionFailedError otherwise.

        A call without ``If-Match`` takes its turn too: what a conditional call has compared stands until it is done.
        Calls that take permission away are not checked. Where one comes
        between look and act, the engine refuses what it takes back: an arm that was asked for before a disarming, a
        release before a hold (`engine.control.turn_inputs`). An arm beside a hold is done, and the beam stays held.
        """
        if not self._turn.acquire(timeout=LONGEST_WAIT_S):
            msg = f"another call that changes a session took longer than {LONGEST_WAIT_S:g} s"
            raise EngineTimeoutError(msg)
        try:
            if wanted.is_given:
                wanted.require(self.etag(session_id))
            yield
        finally:
            self._turn.release()


def _newest_decision(db: Session, session_id: str) -> int:
    query = select(func.max(AuditRow.sequence)).where(
        AuditRow.session_id == session_id, AuditRow.action.in_(DECISIONS), AuditRow.outcome != "refused"
    )
    return db.scalar(query) or 0
