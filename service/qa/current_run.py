"""The QA run in progress in this process, if any."""

from dataclasses import dataclass

from sqlalchemy.orm import Session

from service.qa import schemas, views
from service.qa.jobs import Handle
from service.storage.database.tables import QaRunRow


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Current:
    """A run in progress and its handle."""

    run_id: str
    handle: Handle


class CurrentRun:
    """Holds the run in progress; ``current`` is replaced atomically, so any thread may read it."""

    def __init__(self) -> None:
        self.current: Current | None = None

    @property
    def run_id(self) -> str | None:
        """The id of the run in progress, or None."""
        current = self.current
        return None if current is None else current.run_id

    def run_answer(self, db: Session, row: QaRunRow) -> schemas.QaRun:
        """Return a run with its progress."""
        current = self._of(row)
        progress = None if current is None else current.handle.progress
        return views.run_answer(db, row, is_under_way=current is not None, progress=progress)

    def run_detail(self, db: Session, row: QaRunRow) -> schemas.QaRunDetail:
        """Return a run with its progress and checks."""
        current = self._of(row)
        progress = None if current is None else current.handle.progress
        return views.run_detail(db, row, is_under_way=current is not None, progress=progress)

    def _of(self, row: QaRunRow) -> Current | None:
        current = self.current
        return current if current is not None and current.run_id == row.id else None
