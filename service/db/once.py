"""A writing that is tried until it is done, and done once: also where a commit was done and its answer was lost."""

from collections.abc import Callable

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.db.engine import Database
from service.db.models import AuditRow

Seal = tuple[int, str]

_NEWEST = select(AuditRow.sequence, AuditRow.hash).order_by(AuditRow.sequence.desc()).limit(1)


class OnceWriter:
    """Remembers the last audit row of what it tried; the next try looks whether that row is there.

    The write lock orders them: whoever has it sees what became of the transaction before. Everything written this way
    ends with an audit row of its own.
    """

    def __init__(self, database: Database) -> None:
        self._database = database
        self._tried: tuple[object, Seal] | None = None

    def write(self, subject: object, write: Callable[[Session], None]) -> None:
        """Commit what ``write`` does; tried again with the same ``subject`` it is not done twice."""
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
