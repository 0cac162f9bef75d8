"""Looks at the stages of a frame's way from outside: how long each takes, and how many bytes it must at least move.

The names that the pipeline calls its stages by are replaced for as long as a ``with`` lasts, and put back. A stage that
calls another is charged only what is its own, so that the stages and the rest add up to the frame.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

import engine.evaluation.speed.session as session_module
import engine.pipeline as pipeline_module
import engine.region_finder as finder_module
from engine.pipeline import Pipeline
from engine.region_finder import RegionFinder
from engine.stages import markers as marker_stage
from engine.stages.markers import RADIUS_STEP_PX, RING_RADII
from engine.stages.projection import STRIDE_PX
from engine.stages.roi import NODE_COLUMNS, NODE_ROWS

MARKERS, RAYS, ALIGNMENT, CUT_OUT = "markers", "region: rays", "region: alignment", "region: cut-out"
PROJECTION, MOTION, GATE, REST = "projection", "motion", "gate step", "the rest"
STAGES = (MARKERS, RAYS, ALIGNMENT, CUT_OUT, PROJECTION, MOTION, GATE, REST)

Place = tuple[object, str, str]
PLACES: tuple[Place, ...] = (
    (Pipeline, "measure", REST),
    (RegionFinder, "find", MARKERS),
    (RegionFinder, "region", RAYS),
    (finder_module, "align", ALIGNMENT),
    (finder_module, "cut_out", CUT_OUT),
    (pipeline_module, "project", PROJECTION),
    (Pipeline, "_motion", MOTION),
    (session_module, "step_gate", GATE),
)
"""Who holds a stage, under which name, and what it is called here."""

# `Any`: a stage has whatever signature it has.
Stage = Callable[..., Any]


@contextmanager
def replaced(places: Sequence[Place], wrap: Callable[[str, Stage], Stage]) -> Iterator[None]:
    """Put ``wrap(name here, function)`` in each place, and the functions back at the end."""
    before = [(owner, name, getattr(owner, name)) for owner, name, _ in places]
    try:
        for (owner, name, stage), (_, _, function) in zip(places, before, strict=True):
            setattr(owner, name, wrap(stage, function))
        yield
    finally:
        for owner, name, function in before:
            setattr(owner, name, function)


class StageClock:
    """Adds up what each stage spends by itself, without the stages that it calls."""

    def __init__(self, now_ns: Callable[[], int] = time.perf_counter_ns) -> None:
        self._now_ns = now_ns
        self._spent_ns = dict.fromkeys(STAGES, 0)
        self._called_ns = 0

    def wrap(self, stage: str, function: Stage) -> Stage:
        """Return the function with its time taken."""

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
        """Return what each stage spent since the last call [ns], in the order of STAGES."""
        spent = [self._spent_ns[stage] for stage in STAGES]
        self._spent_ns = dict.fromkeys(STAGES, 0)
        self._called_ns = 0
        return spent


class TrafficMeter:
    """Works out, from the arrays of a real frame, what each stage has to read and to write at least [bytes].

    Every input counts once and every output once, however often a stage really goes over them.
    """

    def __init__(self) -> None:
        self.bytes = dict.fromkeys(STAGES, 0)

    def wrap(self, stage: str, function: Stage) -> Stage:
        """Return the function with its arrays looked at."""
        count = _COUNTS.get(stage)
        if count is None:
            return function

        # `Any`: see Stage.
        def watched(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
            result = function(*args, **kwargs)
            self.bytes[stage] = count(args, result)
            return result

        return watched


TRAFFIC_PLACES: tuple[Place, ...] = (
    (marker_stage, "track_markers", MARKERS),
    *(place for place in PLACES if place[2] not in {MARKERS, REST}),
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
    """Count four centres in and a ray (x/z, y/z, 1) a node out."""
    return array_bytes(args[2]) + NODE_ROWS * NODE_COLUMNS * 3 * np.dtype(np.float64).itemsize


def _cut_out(args: tuple[Any, ...], roi: object) -> int:
    """Count the part of the depth picture that holds the region, what its readings mean, and the grid."""
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
    """Count what is linear in the coefficients, the rays, and the motion."""
    _, active, outcome, rays = args[:4]
    read = (active.regions.mean_mm, active.regions.modes, active.regions.is_known, active.node_mean_mm)
    return array_bytes((*read, active.node_modes, outcome.coefficients, rays)) + array_bytes(motion)


def _gate(args: tuple[Any, ...], _gate: object) -> int:
    """Count the coefficients, which the gate looks at one by one; all else is single numbers."""
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
