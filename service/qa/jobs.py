"""A QA run at work: its inputs and its line, carried out once, and ended in one of three ways.

Whichever way it ends, the line is held and closed before anything is written down.
"""

from collections.abc import Callable
from typing import Protocol

from engine.errors import TidegateError
from engine.qa.bounds import QaBaseline, QaBounds
from engine.qa.results import QaNeed, QaReport
from engine.qa.run import Progress
from service.qa.line import TAKEN, GuardedLine
from service.qa.records import QaOutcome

UNEXPECTED = QaOutcome(status="failed", detail="an unexpected error; it is in the service's log")


class QaCancelledError(Exception):
    """Somebody cancelled the run; no TidegateError, so that no stage takes it for a failure of its own."""


class QaJob(Protocol):
    """Everything a run needs, made before it begins and not open yet."""

    @property
    def line(self) -> GuardedLine:
        """The beam line that the run has."""

    @property
    def own_baseline(self) -> QaBaseline | None:
        """What a virtual set-up should read; None where the site's baseline holds."""

    def run(self, *, bounds: QaBounds, baseline: QaBaseline, on_progress: Progress) -> QaReport:
        """Measure and judge; opens what it needs and closes it."""


class Handle:
    """What others may do to a run under way: look how far it is, and cancel it."""

    def __init__(self, line: GuardedLine) -> None:
        self._line = line
        self.progress: tuple[QaNeed, int, int | None] | None = None
        self.cancelled_by: str | None = None

    def cancel(self, operator: str) -> None:
        """Hold the line for good, then end the run at its next step."""
        self._line.take_away()
        self.cancelled_by = operator

    def step(self, stage: QaNeed, done: int, total: int | None) -> None:
        """Note how far the run is; raise QaCancelledError once it was cancelled."""
        if self._line.is_taken_away:
            raise QaCancelledError
        self.progress = (stage, done, total)


def carry_out(
    job: QaJob,
    handle: Handle,
    *,
    bounds: QaBounds,
    baseline: QaBaseline,
    on_end: Callable[[QaOutcome], None],
    also: Progress | None = None,
) -> QaOutcome:
    """Do a run and tell ``on_end`` how it ended, whatever happens; ``also`` is told of every step.

    What is no TidegateError passes on, once the end was told.
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
