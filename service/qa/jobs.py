"""Run one QA job to its outcome: finished, cancelled or failed.

The line is held and closed before the outcome is reported. The rig is the role that builds jobs; tests use a fake.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from engine.core.errors import TidegateError
from engine.qa import QaBaseline, QaBounds, QaNeed, QaReport
from service.qa.guarded_line import TAKEN, GuardedLine
from service.qa.queries import QaOutcome

if TYPE_CHECKING:  # the run's fits are loaded with the first run
    from engine.qa import Progress
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy.orm import Session

from engine.calibration import Calibration
from service.qa import schemas, views
from service.storage.database.tables import QaRunRow

UNEXPECTED = QaOutcome(status="failed", detail="an unexpected error; it is in the service's log")


class QaCancelledError(Exception):
    """The run was cancelled; not a TidegateError, so that no stage treats it as a failure."""


class QaJob(Protocol):
    """Inputs and beam line of a run, not opened yet."""

    @property
    def line(self) -> GuardedLine:
        """The guarded beam line of the run."""

    @property
    def own_baseline(self) -> QaBaseline | None:
        """The baseline of a virtual set-up; None if the site's baseline applies."""

    def run(self, *, bounds: QaBounds, baseline: QaBaseline, on_progress: "Progress") -> QaReport:
        """Open the inputs, measure, judge and close them."""


class Handle:
    """Progress and cancellation of a running job, for other threads."""

    def __init__(self, line: GuardedLine) -> None:
        self._line = line
        self.progress: tuple[QaNeed, int, int | None] | None = None
        self.cancelled_by: str | None = None

    def cancel(self, operator: str) -> None:
        """Hold the line permanently; the run ends at its next step."""
        self._line.take_away()
        self.cancelled_by = operator

    def step(self, stage: QaNeed, done: int, total: int | None) -> None:
        """Store the progress of the run; raise QaCancelledError after a cancellation."""
        if self._line.is_taken_away:
            raise QaCancelledError
        self.progress = (stage, done, total)


def run_job(
    job: QaJob,
    handle: Handle,
    *,
    bounds: QaBounds,
    baseline: QaBaseline,
    on_end: Callable[[QaOutcome], None],
    also: "Progress | None" = None,
) -> QaOutcome:
    """Run a job and return its outcome; ``also`` receives every step.

    ``on_end`` is always called with the outcome; an exception that is no TidegateError is raised after that call.
    """
    outcome = UNEXPECTED

    def step(stage: QaNeed, done: int, total: int | None) -> None:
        handle.step(stage, done, total)
        if also is not None:
            also(stage, done, total)

    try:
        report = job.run(bounds=bounds, baseline=baseline, on_progress=step)
        outcome = QaOutcome(status="finished", report=report)
    except QaCancelledError:
        pass
    except TidegateError as error:
        outcome = QaOutcome(status="failed", detail=str(error))
    except KeyboardInterrupt:
        handle.cancel("Ctrl-C")
        raise
    finally:
        job.line.hold(TAKEN)
        job.line.close()
        if job.line.is_taken_away:
            outcome = QaOutcome(status="cancelled", detail=f"cancelled by {handle.cancelled_by or 'the service'}")
        on_end(outcome)
    return outcome


@dataclass(frozen=True, slots=True, kw_only=True)
class QaFiles:
    """Paths of the recordings and the trace; None for a live camera and for an input that the run does not use."""

    plate: Path | None = None
    phantom: Path | None = None
    trace: Path | None = None


class QaRig(Protocol):
    """Builds QA jobs on cameras, recordings and the beam line."""

    def job(self, request: schemas.QaRunRequest, files: QaFiles, calibration: Calibration | None) -> QaJob:
        """Build the job of a run without opening anything; raise a TidegateError naming what cannot be used."""


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
