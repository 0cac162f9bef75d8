"""Run one QA job to its outcome: finished, cancelled or failed.

The line is held and closed before the outcome is reported.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from engine.core.errors import TidegateError
from engine.qa.bounds import QaBaseline, QaBounds
from engine.qa.results import QaNeed, QaReport
from service.qa.guarded_line import TAKEN, GuardedLine
from service.qa.queries import QaOutcome

if TYPE_CHECKING:  # the run's fits are loaded with the first run
    from engine.qa.run import Progress

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
