"""Printed tables of the benchmark: times of a frame, everything else that was measured, and the targets."""

from typing import TYPE_CHECKING

from engine.lab.evaluation.table import Cell, Table
from engine.lab.performance.marks import SpeedMark
from engine.lab.performance.results import SpeedFigures

if TYPE_CHECKING:
    from engine.lab.performance.figures import Timing


def speed_tables(figures: SpeedFigures, marks: list[SpeedMark]) -> list[Table]:
    """Return the tables of all parts; the marks come last."""
    return [_times(figures), _others(figures), _marks(marks)]


def _times(figures: SpeedFigures) -> Table:
    frames = figures.frames
    timings: list[tuple[str, Timing]] = [
        ("frame to gate", frames.whole),
        ("frame to gate, processor time", frames.whole_cpu),
        ("the same with the numpy forms", frames.numpy_cpu),
        ("plain method of the article", frames.plain),
    ]
    for ours, numpys in zip(frames.decoding, frames.numpy_decoding, strict=True):
        timings += [(f"decode {ours.name}", ours.timing), ("the same with the numpy forms", numpys.timing)]
    timings += [(f"frame to gate while fitting, {_cores(one.cores)}", one.timing) for one in figures.while_fitting]
    return Table(
        name="times",
        title="Times of a frame",
        columns=("", "median [us]", "p99 [us]", "p99.9 [us]", "largest [us]", "samples"),
        rows=tuple((name, one.median_us, one.p99_us, one.p999_us, one.max_us, one.samples) for name, one in timings),
        digits=1,
        note=f"Median and p99 are medians over blocks. {frames.median_ratio:.1f} times faster than the plain method; "
        f"{frames.compiled_ratio:.2f} times faster than the numpy forms by processor time ({figures.machine.frame_path}"
        f"). Other processes used the core for {frames.lost_core_share:.1%} of the time.",
    )


def _others(figures: SpeedFigures) -> Table:
    fit, memory = figures.fit, figures.memory
    rows: list[tuple[Cell, ...]] = [
        (f"fit of {fit.frames} frames (equations 1 to 5)", fit.fit_s, "s"),
        ("training job: checks, fit, preparing, reference", fit.job_s, "s"),
    ]
    rows += [(f"training job while frames come, {_cores(one.cores)}", one.job_s, "s") for one in figures.while_fitting]
    for one in figures.throughput:
        rows += [
            (f"tidegate measure, {one.name}", one.whole_per_s, "frames/s"),
            (f"tidegate measure, {one.name}, once learned", one.steady_per_s, "frames/s"),
            (f"tidegate measure, {one.name}, by processor time", one.per_processor_s, "frames/s"),
        ]
    for minutes, least_mb, peak_mb, used_mb in (
        (memory.warm_s / 60.0, memory.start_mb, memory.peak_start_mb, memory.used_start_mb),
        (memory.session_s / 60.0, memory.end_mb, memory.peak_end_mb, memory.used_end_mb),
    ):
        rows += [
            (f"resident memory after {minutes:g} min, least", least_mb, "MB"),
            (f"resident memory after {minutes:g} min, highest", peak_mb, "MB"),
            (f"heap in use after {minutes:g} min, least", used_mb, "MB"),
        ]
    return Table(
        name="others",
        title="Learning, recordings from disk, memory",
        columns=("", "measured", "unit"),
        rows=tuple(rows),
        note=f"Memory: {memory.frames} frames through the engine's loop, {memory.models} models learned; the training "
        "process's own memory included. A leak shows in the heap in use.",
    )


def _marks(marks: list[SpeedMark]) -> Table:
    return Table(
        name="marks",
        title="Performance targets",
        columns=("mark", "bound", "measured", "unit", "verdict"),
        rows=tuple(
            (
                mark.name,
                f"{'≥' if mark.is_least else '≤'} {mark.bound:g}",
                mark.value,
                mark.unit,
                "met" if mark.is_met else "NOT MET",
            )
            for mark in marks
        ),
        failed=frozenset(number for number, mark in enumerate(marks) if not mark.is_met),
    )


def _cores(count: int) -> str:
    return "one core" if count == 1 else f"{count} cores"
