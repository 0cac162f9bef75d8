"""A whole run: measure what the kind asks for, stage after stage, and judge every figure.

A stage that cannot be measured fails each of its checks and says why; the next stage is done all the same. What the
caller's ``on_progress`` raises, to cancel, ends the run at once; a line that was open is held first and closed.
"""

from collections.abc import Callable, Iterable
from typing import TypeAlias

from engine.qa.bounds import QaBaseline, QaBounds
from engine.qa.checks import checks_of
from engine.qa.inputs import QaInputs
from engine.qa.results import QaFigure, QaKind, QaNeed, QaReport, QaResult, QaSeries, judge

Progress: TypeAlias = Callable[[QaNeed, int, int | None], None]
"""Told (stage, done, total): frames or pulses; the total is None where nobody knows it."""

Measured: TypeAlias = tuple[Iterable[QaFigure], Iterable[QaSeries]]


def no_progress(_stage: QaNeed, _done: int, _total: int | None) -> None:
    """Tell nobody."""


def run_qa(
    kind: QaKind,
    inputs: QaInputs,
    *,
    bounds: QaBounds,
    baseline: QaBaseline,
    on_progress: Progress = no_progress,
) -> QaReport:
    """Do a run.

    Parameters
    ----------
    on_progress
        Called often, about 30 times a second of a recording and after every pulse; whatever it raises cancels the run.

    Raises
    ------
    InvalidValueError
        Something the kind needs was not given; names it, before anything is opened.
    """
    raise NotImplementedError


def judged(kind: QaKind, figures: Iterable[QaFigure], bounds: QaBounds, baseline: QaBaseline) -> tuple[QaResult, ...]:
    """Judge every check of a kind; one that nothing was measured for is a fail."""
    measured = {figure.code: figure for figure in figures}
    return tuple(
        judge(
            measured.get(check.code) or QaFigure(code=check.code, value=None),
            check,
            bounds.of(check.code),
            baseline.of(check.code),
        )
        for check in checks_of(kind)
    )
