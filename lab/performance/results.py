"""Results of the benchmark: figures (the keys of ``bench.json``), performance targets ("marks"), and printed tables."""

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

from engine.core.clock import US_PER_S
from lab.evaluation.table import Cell, Table
from lab.performance.frames import FrameCosts, FrameSizes
from lab.performance.machine import Machine
from lab.performance.memory import MemorySizes, MemoryUse
from lab.performance.throughput import FitCost, FitSizes, FramesWhileFitting, Throughput

if TYPE_CHECKING:
    from lab.performance.machine import Timing

MIN_RATIO = 30.0
MOST_SPREAD = 2.0
MOST_CALLS = 250.0
FIT_S = 0.3
FITTING_RATIO = 1.5
DEPTH_US = 350.0
MIN_MEASURED_RATIOS = (8.0, 13.0, 15.0)
"""Rate of `tidegate measure` on one core, on two, and on two recordings at once, over the plain method's on one."""
FLAT_MB = 8.0
"""Largest accepted growth of a session's memory; a fit's temporary arrays vary by more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedSizes:
    """Amount of work of each part."""

    frames: FrameSizes
    fit: FitSizes
    memory: MemorySizes
    measure_runs: int


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedFigures:
    """All figures; ``load_averages`` are the one-minute load averages before each part and at the end."""

    machine: Machine
    sizes: SpeedSizes
    frames: FrameCosts
    fit: FitCost
    while_fitting: tuple[FramesWhileFitting, ...]
    throughput: tuple[Throughput, ...]
    memory: MemoryUse
    load_averages: tuple[float, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class SpeedMark:
    """One target; ``is_least`` if the bound is a minimum, otherwise it is a maximum."""

    name: str
    bound: float
    value: float
    unit: str
    is_least: bool = False

    @property
    def is_met(self) -> bool:
        """Whether the target is met; never for NaN."""
        if math.isnan(self.value):
            return False
        return self.value >= self.bound if self.is_least else self.value <= self.bound


def reach(figures: SpeedFigures) -> list[SpeedMark]:
    """Compare the figures with every target."""
    frames, fit, memory = figures.frames, figures.fit, figures.memory
    marks = [
        SpeedMark(
            name="plain method over ours, medians",
            bound=MIN_RATIO,
            value=frames.median_ratio,
            unit="times",
            is_least=True,
        ),
        SpeedMark(name="frame to gate, p99 over median", bound=MOST_SPREAD, value=frames.spread, unit="times"),
        SpeedMark(name="Python calls a frame", bound=MOST_CALLS, value=frames.calls, unit=""),
        SpeedMark(name=f"fit of {fit.frames} frames", bound=FIT_S, value=fit.fit_s, unit="s"),
        SpeedMark(
            name=f"decode {frames.decoding[0].name}",
            bound=DEPTH_US,
            value=frames.decoding[0].timing.median_us,
            unit="us",
        ),
    ]
    marks += [
        SpeedMark(
            name=f"frame to gate while fitting, p99 over quiet, {_cores(costs.cores)}",
            bound=FITTING_RATIO,
            value=costs.p99_ratio,
            unit="times",
        )
        for costs in figures.while_fitting
    ]
    marks += [
        SpeedMark(
            name=f"tidegate measure over the plain method, {one.name}",
            bound=bound,
            value=one.whole_per_s * frames.plain.median_us / US_PER_S,
            unit="times",
            is_least=True,
        )
        for one, bound in zip(figures.throughput, MIN_MEASURED_RATIOS, strict=False)
    ]
    name = f"memory growth over {memory.session_s / 60.0:g} min"
    return [*marks, SpeedMark(name=name, bound=FLAT_MB, value=memory.growth_mb, unit="MB")]


def _cores(count: int) -> str:
    return "one core" if count == 1 else f"{count} cores"


def speed_tables(figures: SpeedFigures, marks: list[SpeedMark]) -> list[Table]:
    """Return the tables of all parts; the marks come last."""
    return [_times(figures), _others(figures), _marks(marks)]


def _times(figures: SpeedFigures) -> Table:
    frames = figures.frames
    timings: list[tuple[str, Timing]] = [
        ("frame to gate", frames.to_gate),
        ("whole frame, with what is learned after it", frames.whole),
        ("the same, processor time", frames.whole_cpu),
        ("the same with the numpy forms", frames.numpy_cpu),
        ("plain method of the article", frames.plain),
        ("OpenCV's RGB-D odometry of the region", frames.peer),
    ]
    for ours, numpys in zip(frames.decoding, frames.numpy_decoding, strict=True):
        timings += [(f"decode {ours.name}", ours.timing), ("the same with the numpy forms", numpys.timing)]
    for one in figures.while_fitting:
        timings += [
            (f"frame to gate at the recording's rate, {_cores(one.cores)}", one.quiet),
            (f"the same while a model is fitted, {_cores(one.cores)}", one.timing),
        ]
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
