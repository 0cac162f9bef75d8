"""Performance targets ("marks") for speed and memory, and whether they are met."""

import math
from dataclasses import dataclass

from engine.lab.performance.results import SpeedFigures

MEDIAN_US, P99_US = 400.0, 1000.0
MIN_RATIO = 30.0
FIT_S = 0.3
FITTING_P99_US = 2500.0
DEPTH_US = 350.0
MIN_FRAMES_PER_S = (400.0, 600.0, 750.0)
"""Of `tidegate measure` on one core, on two, and on two recordings at once."""
FLAT_MB = 8.0
"""Largest accepted growth of a session's memory; a fit's temporary arrays vary by more."""


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
        SpeedMark(name="frame to gate, median", bound=MEDIAN_US, value=frames.whole.median_us, unit="us"),
        SpeedMark(name="frame to gate, p99", bound=P99_US, value=frames.whole.p99_us, unit="us"),
        SpeedMark(
            name="plain method over ours, medians",
            bound=MIN_RATIO,
            value=frames.median_ratio,
            unit="times",
            is_least=True,
        ),
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
            name=f"frame to gate while fitting, p99, {_cores(costs.cores)}",
            bound=FITTING_P99_US,
            value=costs.timing.p99_us,
            unit="us",
        )
        for costs in figures.while_fitting
    ]
    marks += [
        SpeedMark(
            name=f"tidegate measure, {one.name}",
            bound=bound,
            value=one.whole_per_s,
            unit="frames/s",
            is_least=True,
        )
        for one, bound in zip(figures.throughput, MIN_FRAMES_PER_S, strict=False)
    ]
    name = f"memory growth over {memory.session_s / 60.0:g} min"
    return [*marks, SpeedMark(name=name, bound=FLAT_MB, value=memory.growth_mb, unit="MB")]


def _cores(count: int) -> str:
    return "one core" if count == 1 else f"{count} cores"
