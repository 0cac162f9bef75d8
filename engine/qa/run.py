"""A whole run: measure what the kind asks for, stage after stage, and judge every figure.

A stage that cannot be measured fails each of its checks and says why; the next stage is done all the same. What the
caller's ``on_progress`` raises, to cancel, ends the run at once; a line that was open is held first and closed.
"""

from collections.abc import Callable, Iterable
from typing import TypeAlias

from engine.qa.bounds import QaBaseline, QaBounds
from engine.qa.checks import checks_of, needs_of
from engine.qa.drill import DRILLS, drill_line
from engine.qa.inputs import QaInputs
from engine.qa.phantom import measure_phantom
from engine.qa.plate import measure_plate
from engine.qa.results import QaFigure, QaKind, QaNeed, QaReport, QaResult, QaSeries, judge

Progress: TypeAlias = Callable[[QaNeed, int, int | None], None]
"""Told (stage, done, total): frames or pulses; the total is None where nobody knows it."""


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
    inputs.check(kind)
    figures: list[QaFigure] = []
    series: list[QaSeries] = []
    for need in needs_of(kind):
        found, drawn = _measured(need, inputs, on_progress)
        figures += found
        series += drawn
    figures.append(_total(figures))
    return QaReport(kind=kind, results=judged(kind, figures, bounds, baseline), series=tuple(series))


def _total(figures: Iterable[QaFigure]) -> QaFigure:
    """From the phantom's leaving the window to the line read back off: the gate's delay and the line's."""
    values = {figure.code: figure.value for figure in figures}
    gate_ms, line_ms = values.get("gate_delay_off_ms"), values.get("beam_readback_off_ms")
    if gate_ms is None or line_ms is None:
        return QaFigure(code="beam_off_total_ms", value=None, detail="the gate's delay or the line's is not known")
    detail = f"gate {gate_ms:.0f} ms, line {line_ms:.0f} ms"
    return QaFigure(code="beam_off_total_ms", value=gate_ms + line_ms, detail=detail)


def _measured(need: QaNeed, inputs: QaInputs, on_progress: Progress) -> tuple[list[QaFigure], list[QaSeries]]:
    """Measure with one of what was given."""
    plate, phantom, beam = inputs.plate, inputs.phantom, inputs.beam

    def told(total: int | None) -> Callable[[int], None]:
        return lambda done: on_progress(need, done, total)

    if need is QaNeed.PLATE and plate is not None:
        return measure_plate(plate, told(None))
    if need is QaNeed.PHANTOM and phantom is not None:
        return measure_phantom(phantom, told(None))
    if need is QaNeed.BEAM and beam is not None:
        return drill_line(beam, told(len(DRILLS) * beam.repeats)), []
    return [], []


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
