"""A QA run: measure the stages of its kind in order, and judge every figure.

A stage that cannot be measured fails each of its checks with the reason; the next stage still runs. An exception from
the caller's ``on_progress`` cancels the run at once; an open beam line is held first, then closed.
"""

from collections.abc import Callable, Iterable
from typing import TypeAlias

from engine.qa.bounds import QaBaseline, QaBounds
from engine.qa.checks import checks_of, needs_of
from engine.qa.drill import DRILLS, drill_line
from engine.qa.inputs import QaInputs
from engine.qa.latency.measure import measure_latency
from engine.qa.phantom import measure_phantom
from engine.qa.plate import measure_plate
from engine.qa.results import QaFigure, QaKind, QaNeed, QaReport, QaResult, QaSeries, judge

Progress: TypeAlias = Callable[[QaNeed, int, int | None], None]
"""Called with (stage, done, total), in frames or pulses; the total is None where it is unknown."""


def no_progress(_stage: QaNeed, _done: int, _total: int | None) -> None:
    """Ignore the progress."""


def run_qa(
    kind: QaKind,
    inputs: QaInputs,
    *,
    bounds: QaBounds,
    baseline: QaBaseline,
    on_progress: Progress = no_progress,
) -> QaReport:
    """Measure and judge one run.

    Parameters
    ----------
    on_progress
        Called for every frame and after every pulse; an exception from it cancels the run.

    Raises
    ------
    InvalidValueError
        An input that the kind needs is missing; raised before any source or line is opened.
    """
    inputs.check(kind)
    figures: list[QaFigure] = []
    series: list[QaSeries] = []
    for need in needs_of(kind):
        stage_figures, stage_series = _measured(need, inputs, on_progress)
        figures += stage_figures
        series += stage_series
    figures.append(_total(figures))
    return QaReport(kind=kind, results=judge_all(kind, figures, bounds, baseline), series=tuple(series))


def _total(figures: Iterable[QaFigure]) -> QaFigure:
    """Add the gate's delay off and the line's: from the phantom leaving the window to the line read back off [ms]."""
    values = {figure.code: figure.value for figure in figures}
    gate_ms, line_ms = values.get("gate_delay_off_ms"), values.get("beam_readback_off_ms")
    if gate_ms is None or line_ms is None:
        return QaFigure(code="beam_off_total_ms", value=None, detail="the delay of the gate or of the line is unknown")
    detail = f"gate {gate_ms:.0f} ms, line {line_ms:.0f} ms"
    return QaFigure(code="beam_off_total_ms", value=gate_ms + line_ms, detail=detail)


def _measured(need: QaNeed, inputs: QaInputs, on_progress: Progress) -> tuple[list[QaFigure], list[QaSeries]]:
    """Measure one stage; nothing where its input is missing."""
    plate, phantom, beam, camera = inputs.plate, inputs.phantom, inputs.beam, inputs.camera

    def progress(total: int | None) -> Callable[[int], None]:
        return lambda done: on_progress(need, done, total)

    if need is QaNeed.PLATE and plate is not None:
        return measure_plate(plate, progress(None))
    if need is QaNeed.PHANTOM and phantom is not None:
        return measure_phantom(phantom, progress(None))
    if need is QaNeed.BEAM and beam is not None:
        return drill_line(beam, progress(len(DRILLS) * beam.repeats)), []
    if need is QaNeed.CAMERA and camera is not None:
        return measure_latency(camera, progress(None))
    return [], []


def judge_all(
    kind: QaKind, figures: Iterable[QaFigure], bounds: QaBounds, baseline: QaBaseline
) -> tuple[QaResult, ...]:
    """Judge every check of a kind, in the table's order; a check without a figure fails, unless it is optional."""
    measured = {figure.code: figure for figure in figures}
    return tuple(
        judge(
            measured.get(check.code) or QaFigure(code=check.code, value=None),
            check,
            bounds.of(check.code),
            baseline.of(check.code),
        )
        for check in checks_of(kind)
        if check.code in measured or not check.is_optional
    )
