"""Retried writes that take effect once, even if a commit succeeded but its answer was lost."""

from collections.abc import Callable

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.storage.database.engine import Database
from service.storage.database.tables import AuditRow

Seal = tuple[int, str]

_NEWEST = select(AuditRow.sequence, AuditRow.hash).order_by(AuditRow.sequence.desc()).limit(1)


class RetriedWriter:
    """Remembers the last audit row of a failed attempt; the next attempt checks whether that row was committed.

    The write lock guarantees that the outcome of the former transaction is visible. Every write must end with its own
    audit row.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._tried: tuple[object, Seal] | None = None

    def write(self, subject: object, write: Callable[[Session], None]) -> None:
        """Run ``write`` and commit; a retry with the same ``subject`` object does not repeat a committed write."""
        with self._database.write() as db:
            if not self._is_done(db, subject):
                write(db)
                sequence, seal = db.execute(_NEWEST).one()
                self._tried = (subject, (sequence, seal))
        self._tried = None

    def _is_done(self, db: Session, subject: object) -> bool:
        if self._tried is None or self._tried[0] is not subject:
            return False
        sequence, seal = self._tried[1]
        return db.scalar(select(AuditRow.hash).where(AuditRow.sequence == sequence)) == seal
