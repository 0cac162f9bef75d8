"""Measures the stages of the frame path from outside: their time, and a lower bound of the bytes they move.

The names by which the pipeline calls its stages are replaced inside a ``with`` block and restored after it. A stage's
time excludes the stages that it calls, so that all stages and the rest add up to the frame.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

import engine.motion.pipeline as pipeline_module
import engine.motion.tracking.region_tracker as finder_module
import engine.verification.performance.session as session_module
from engine.core.frames import NODE_COLUMNS, NODE_ROWS
from engine.motion.pipeline import Pipeline
from engine.motion.stages import markers as marker_stage
from engine.motion.stages.markers import RADIUS_STEP_PX, RING_RADII
from engine.motion.stages.projection import STRIDE_PX
from engine.motion.tracking.region_tracker import RegionTracker

MARKERS, RAYS, ALIGNMENT, CUT_OUT = "markers", "region: rays", "region: alignment", "region: cut-out"
PROJECTION, MOTION, GATE, REST = "projection", "motion", "gate step", "the rest"
STAGES = (MARKERS, RAYS, ALIGNMENT, CUT_OUT, PROJECTION, MOTION, GATE, REST)

StageSite = tuple[object, str, str]
STAGE_SITES: tuple[StageSite, ...] = (
    (Pipeline, "measure", REST),
    (RegionTracker, "find", MARKERS),
    (RegionTracker, "region", RAYS),
    (finder_module, "align", ALIGNMENT),
    (finder_module, "cut_out", CUT_OUT),
    (pipeline_module, "project", PROJECTION),
    (Pipeline, "_motion", MOTION),
    (session_module, "step_gate", GATE),
)
"""Owner of each stage, its attribute name there, and its name in the tables."""

# `Any`: stages have different signatures.
Stage = Callable[..., Any]


@contextmanager
def replaced(sites: Sequence[StageSite], wrap: Callable[[str, Stage], Stage]) -> Iterator[None]:
    """Replace each function by ``wrap(stage name, function)`` inside the block, and restore it afterwards."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in sites]
    try:
        for (owner, name, stage), (_, _, function) in zip(sites, before, strict=True):
            setattr(owner, name, wrap(stage, function))
        yield
    finally:
        for owner, name, function in before:
            setattr(owner, name, function)


class StageClock:
    """Sums the time of each stage, without the stages that it calls."""

    def __init__(self, now_ns: Callable[[], int] = time.perf_counter_ns) -> None:
        self._now_ns = now_ns
        self._spent_ns = dict.fromkeys(STAGES, 0)
        self._called_ns = 0

    def wrap(self, stage: str, function: Stage) -> Stage:
        """Return the function with a timer around it."""

        # `Any`: see Stage.
        def timed(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
            outer_ns, self._called_ns = self._called_ns, 0
            started_ns = self._now_ns()
            try:
                return function(*args, **kwargs)
            finally:
                took_ns = self._now_ns() - started_ns
                self._spent_ns[stage] += took_ns - self._called_ns
                self._called_ns = outer_ns + took_ns

        return timed

    def take_ns(self) -> list[int]:
        """Return the time of each stage since the last call [ns], in the order of `STAGES`."""
        spent = [self._spent_ns[stage] for stage in STAGES]
        self._spent_ns = dict.fromkeys(STAGES, 0)
        self._called_ns = 0
        return spent


class TrafficMeter:
    """Computes from the arrays of a real frame how many bytes each stage must at least read and write.

    Every input and every output counts once, even if a stage passes over it several times.
    """

    def __init__(self) -> None:
        self.bytes = dict.fromkeys(STAGES, 0)

    def wrap(self, stage: str, function: Stage) -> Stage:
        """Return the function with its argument and result arrays counted."""
        count = _COUNTS.get(stage)
        if count is None:
            return function

        # `Any`: see Stage.
        def watched(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
            result = function(*args, **kwargs)
            self.bytes[stage] = count(args, result)
            return result

        return watched


TRAFFIC_SITES: tuple[StageSite, ...] = (
    (marker_stage, "track_markers", MARKERS),
    *(site for site in STAGE_SITES if site[2] not in {MARKERS, REST}),
)


def array_bytes(value: object) -> int:
    """Size of all arrays in a value: itself, its fields, its members [bytes]."""
    if isinstance(value, np.ndarray):
        return value.nbytes
    if isinstance(value, tuple | list):
        return sum(array_bytes(member) for member in value)
    if is_dataclass(value) and not isinstance(value, type):
        return sum(array_bytes(getattr(value, field.name)) for field in fields(value))
    return 0


def _markers(args: tuple[Any, ...], found: object) -> int:
    """Count four square patches of the colour picture, three bytes a pixel."""
    _, expected_px, search = args
    radius_px = max(round(0.5 * search.diameter_px / RADIUS_STEP_PX), 1) * RADIUS_STEP_PX
    side = 2 * int(np.ceil(RING_RADII[1] * radius_px)) + 1
    return len(expected_px) * side * side * 3 + array_bytes(expected_px) + array_bytes(found)


def _rays(args: tuple[Any, ...], _result: object) -> int:
    """Count four centres as input and one ray (x/z, y/z, 1) per node as output."""
    return array_bytes(args[2]) + NODE_ROWS * NODE_COLUMNS * 3 * np.dtype(np.float64).itemsize


def _cut_out(args: tuple[Any, ...], roi: object) -> int:
    """Count the window of the depth picture around the region, its entries of the depth table, and the grid."""
    depth_mm, nodes_px, table_mm = args[:3]
    (left, top), (right, bottom) = np.floor(nodes_px.min(axis=0)).astype(int), np.ceil(nodes_px.max(axis=0)).astype(int)
    window = depth_mm[max(top, 0) : bottom + 1, max(left, 0) : right + 1]
    table_bytes = len(np.unique(window)) * int(table_mm.itemsize)
    return array_bytes((window, nodes_px)) + table_bytes + array_bytes(roi)


def _projection(args: tuple[Any, ...], found: object) -> int:
    """Count the sampled basis, the sampled region and the coefficients."""
    basis, roi, start = args
    read = (
        basis.sampled_components,
        basis.cosine_rows,
        basis.cosine_columns,
        basis.sampled_mean_mm,
        basis.sampled_known,
        basis.known_gram,
        basis.stiffness,
    )
    thin = roi.thinned(STRIDE_PX)
    return array_bytes(read) + array_bytes(thin) + array_bytes(start) + array_bytes(found)


def _motion(args: tuple[Any, ...], motion: object) -> int:
    """Count the arrays that are linear in the coefficients, the rays, and the motion."""
    _, active, (outcome, *_), rays = args[:4]
    read = (active.regions.mean_mm, active.regions.modes, active.regions.is_known, active.node_mean_mm)
    return array_bytes((*read, active.node_modes, outcome.coefficients, rays)) + array_bytes(motion)


def _gate(args: tuple[Any, ...], _gate: object) -> int:
    """Count the coefficients, which the gate checks one by one; its other inputs are scalars."""
    motion = args[1].motion
    return 0 if motion is None else array_bytes((motion.projection.beta, motion.projection.coefficients))


_COUNTS: dict[str, Callable[[tuple[Any, ...], Any], int]] = {
    MARKERS: _markers,
    RAYS: _rays,
    ALIGNMENT: lambda args, aligned: array_bytes(args) + array_bytes(aligned),
    CUT_OUT: _cut_out,
    PROJECTION: _projection,
    MOTION: _motion,
    GATE: _gate,
}
