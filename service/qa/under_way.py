"""The one QA run that goes on in this process, for whoever asks how it stands."""

from dataclasses import dataclass

from sqlalchemy.orm import Session

from service.db.models import QaRunRow
from service.qa import schemas, views
from service.qa.jobs import Handle


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Current:
    """A run at work."""

    run_id: str
    handle: Handle


class UnderWay:
    """Holds the run that goes on, if there is one; written in one step, so that anybody may read."""

    def __init__(self) -> None:
        self.current: Current | None = None

    @property
    def run_id(self) -> str | None:
        """Which run goes on."""
        current = self.current
        return None if current is None else current.run_id

    def run_answer(self, db: Session, row: QaRunRow) -> schemas.QaRun:
        """Tell a run as it stands."""
        current = self._of(row)
        progress = None if current is None else current.handle.progress
        return views.run_answer(db, row, is_under_way=current is not None, progress=progress)

    def run_detail(self, db: Session, row: QaRunRow) -> schemas.QaRunDetail:
        """Tell a run as it stands, with every check."""
        current = self._of(row)
        progress = None if current is None else current.handle.progress
        return views.run_detail(db, row, is_under_way=current is not None, progress=progress)

    def _of(self, row: QaRunRow) -> Current | None:
        current = self.current
        return current if current is not None and current.run_id == row.id else None
