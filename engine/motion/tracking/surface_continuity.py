"""Continuity check of the surface from frame to frame: skin does not jump.

A sheet or a hand laid on the patient is smooth, and if it is thin the model explains it as motion. But it appears
within one or two frames, faster than a chest can move. After such a change a surface is accepted again when its shape
returns, apart from breathing, or when an operator has set a new reference. A new model that takes the reference over
changes nothing of this. The same holds after every interval without an accepted surface, whatever its reason, since
something may be laid on the patient in it. A patient moves as a whole: a change that a plane describes with a small
remainder is accepted at any speed, and so is one in which the markers move along.

A cough is also fast, and bends the body as no breath does. Some surfaces during a cough may be accepted, so the shape
may also return to the last surface before which a whole second was accepted.

Distances between the markers in mm: a marker that comes off and is attached elsewhere marks another region.

Breathing changes the distances between the markers slowly and within a range; the skin stretches. So each distance is
followed while frames are measured, and its range is kept. From one frame to the next, and after an interval without a
measurement, every distance has to be within that range and a small margin.
"""

import itertools
import math
from dataclasses import dataclass
from operator import itemgetter

import numpy as np

from engine.core.compiled import FramePath
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, FloatArray, Lost, LostReason, RoiDepth
from engine.core.geometry import least_squares
from engine.core.sentences import say
from engine.motion.stages.markers import CORNERS

# A cough moves an abdomen at 50 mm/s; noise adds some tenths of a millimetre.
MAX_STEP_MM = 2.0
MAX_STEP_OF_NOISE = 0.25
FRAME_US = 40_000
# Speed of changes during missed frames; below that of a cough.
MAX_SPEED_MM_S = 25.0
# Longest interval without an accepted surface that does not interrupt continuity: three missed frames.
MAX_HIDDEN_US = 120_000
MOVED_PX = 5.0
CALM_US = 1_000_000
# Share of a change that a plane may leave when the patient moves as a whole; a sheet over one side leaves half.
BENT_SHARE = 0.3
PAIRS = tuple(itertools.combinations(range(4), 2))
_ONES, _OTHERS = (itemgetter(*corners) for corners in zip(*PAIRS, strict=True))
MARGIN_MM = 3.0
"""How far a distance may be outside of its range so far; a marker is found within some tenths of a millimetre."""
CORNER_PX = 20
LEAST_READINGS = 9
Distances = tuple[float, ...]
LEAST_RESCALED = 0.01
"""Least change of all distances by one factor that is named as such."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ObservedSurface:
    """A measured surface: depth at the nodes [mm], shape (nodes,); marker centres [px], shape (4, 2); device time."""

    depth_mm: FloatArray
    markers_px: FloatArray
    timestamp_us: int


class SurfaceContinuity:
    """Keeps the last accepted surface, and the last one after a second of accepted ones."""

    def __init__(self) -> None:
        self._last: ObservedSurface | None = None
        self._calm: ObservedSurface | None = None
        self._calm_since_us: int | None = None
        self._generation = -1
        self._is_broken = False

    def restart(self, generation: int) -> None:
        """Accept the next surface if the reference has changed, as ``generation`` shows."""
        if generation != self._generation:
            self._last, self._generation = None, generation

    def interrupt(self) -> None:
        """Record an occlusion: the next surface need not be continuous, but must have the previous shape."""
        self._is_broken = True
        self._calm_since_us = None

    def rejection(self, observed: ObservedSurface, shapes: FloatArray, noise_mm: float) -> str:
        """Return why a surface is rejected; empty if it is accepted, which also stores it.

        Parameters
        ----------
        shapes
            The learned components at the nodes, shape (k, nodes).
        noise_mm
            Noise of the model, as in `engine.core.motion_model.MotionModel` [mm].
        """
        allowed_mm = max(MAX_STEP_MM, MAX_STEP_OF_NOISE * noise_mm)
        last = self._last
        if last is None or _has_moved(observed, last):
            self._calm, self._calm_since_us = None, None
        else:
            misfit_mm = self._misfit_mm(observed, last, shapes, allowed_mm)
            if misfit_mm is not None:
                self._is_broken, self._calm_since_us = True, None
                return say(
                    "the surface changed by {misfit_mm:.1f} mm, faster than skin can move: "
                    "check for objects on the patient, then set the reference again",
                    misfit_mm=misfit_mm,
                )
        if self._calm_since_us is None or observed.timestamp_us < self._calm_since_us:
            self._calm_since_us = observed.timestamp_us
        if observed.timestamp_us - self._calm_since_us >= CALM_US:
            self._calm = observed
        self._last, self._is_broken = observed, False
        return ""

    def _misfit_mm(
        self, observed: ObservedSurface, last: ObservedSurface, shapes: FloatArray, allowed_mm: float
    ) -> float | None:
        """Return the misfit to the last surface and to the last calm one [mm]; None if the surface fits one of them."""
        hidden_us = max(observed.timestamp_us - last.timestamp_us - FRAME_US, 0)
        if not self._is_broken and hidden_us <= MAX_HIDDEN_US:
            return _beyond_mm(observed.depth_mm, last.depth_mm, allowed_mm + MAX_SPEED_MM_S * hidden_us / 1e6)
        change: FloatArray = observed.depth_mm - last.depth_mm
        misfit_mm = _beyond_breathing_mm(change, shapes, allowed_mm)
        if misfit_mm is None or self._calm is None or _has_moved(observed, self._calm):
            return misfit_mm
        is_back = _beyond_breathing_mm(observed.depth_mm - self._calm.depth_mm, shapes, allowed_mm) is None
        return None if is_back else misfit_mm


def _has_moved(observed: ObservedSurface, before: ObservedSurface) -> bool:
    """Whether a marker has moved by more than `MOVED_PX`; also True for NaN."""
    return not _largest_difference(observed.markers_px, before.markers_px) <= MOVED_PX


def _largest_difference(one: FloatArray, other: FloatArray) -> float:
    """Return the largest difference of two arrays' values; NaN where one of them is no finite number."""
    compiled = FramePath.kernels
    if compiled is not None:
        difference: float = compiled.largest_difference(one, other)
        return difference
    largest = float(np.abs(one - other).max())
    return largest if math.isfinite(largest) else math.nan


def _beyond_mm(now_mm: FloatArray, before_mm: FloatArray, allowed_mm: float) -> float | None:
    """Return the largest change [mm] if it is too large for skin; None if it is not, or if the whole patient moved."""
    if _largest_difference(now_mm, before_mm) <= allowed_mm:
        return None
    change_mm = now_mm - before_mm
    return _beyond_breathing_mm(change_mm, np.empty((0, len(change_mm))), allowed_mm)


def _beyond_breathing_mm(change_mm: FloatArray, shapes: FloatArray, allowed_mm: float) -> float | None:
    """Return the same for what breathing, whose ``shapes`` have (k, nodes), leaves of a change; NaN is too large.

    The whole patient moved if breathing and a plane together describe the change up to a small remainder.
    """
    if not np.isfinite(change_mm).all():
        return float("nan")
    largest_mm = float(np.abs(_without_fit(change_mm, shapes)).max())
    if largest_mm <= allowed_mm:
        return None
    bent_mm = float(np.abs(_without_fit(change_mm, np.concatenate([shapes, _PLANES]))).max())
    return None if bent_mm <= min(allowed_mm, BENT_SHARE * largest_mm) else largest_mm


def _without_fit(change_mm: FloatArray, shapes: FloatArray) -> FloatArray:
    """Subtract the least-squares fit of some shapes from a change [mm], shape (nodes,)."""
    return change_mm - least_squares(shapes, change_mm) @ shapes if len(shapes) else change_mm


def _planes() -> FloatArray:
    """Return piston and both tilts at the nodes, shape (3, nodes)."""
    rows, columns = np.mgrid[0:NODE_ROWS, 0:NODE_COLUMNS].reshape(2, -1).astype(np.float64)
    return np.stack([np.ones_like(rows), rows - rows.mean(), columns - columns.mean()])


_PLANES = _planes()


def marker_points_mm(rays: FloatArray, roi: RoiDepth) -> FloatArray | None:
    """Return the markers' places [mm], shape (4, 3): their rays, shape (4, 3), at the depth of the skin beside them.

    None where too little of the skin beside one of them is seen.
    """
    medians_mm = _corner_medians_mm(roi)
    return None if medians_mm is None else np.asarray(rays * medians_mm[:, None])


def _corner_medians_mm(roi: RoiDepth) -> FloatArray | None:
    """Return the median depth at the region's corners [mm], shape (4,); None where too little of one is seen."""
    reach = max(CORNER_PX // roi.stride_px, 1)
    compiled = FramePath.kernels
    if compiled is None:
        return _medians_mm(roi, reach)
    medians_mm = np.empty(4)
    depth_mm, valid = np.ascontiguousarray(roi.depth_mm), np.ascontiguousarray(roi.valid)
    return medians_mm if compiled.corner_medians(depth_mm, valid, reach, LEAST_READINGS, medians_mm) else None


def _medians_mm(roi: RoiDepth, reach: int) -> FloatArray | None:
    """Return the same with numpy."""
    first, last = slice(0, reach), slice(-reach, None)
    depths_mm = []
    for rows, columns in ((first, first), (first, last), (last, last), (last, first)):
        readings = roi.depth_mm[rows, columns][roi.valid[rows, columns]]
        if readings.size < LEAST_READINGS:
            return None
        depths_mm.append(float(np.median(readings)))
    return np.array(depths_mm)


class MarkerLayout:
    """Follows the six distances between the markers; owned by the pipeline's thread."""

    def __init__(self) -> None:
        self._last_mm: Distances | None = None
        self._lowest_mm: Distances | None = None
        self._highest_mm: Distances | None = None
        self._seen_us = 0
        self._generation = -1
        self._is_doubted = False

    def restart(self, generation: int) -> None:
        """Accept the next layout if the reference has changed, as ``generation`` shows."""
        if generation != self._generation:
            self._last_mm, self._generation = None, generation

    def lost(self, points_mm: FloatArray | None, timestamp_us: int) -> Lost | None:
        """Return the loss if a marker is not where it was relative to the others; otherwise follow the distances.

        Parameters
        ----------
        points_mm
            The markers' places, shape (4, 3); None where they are not known, which leaves the layout as it was.
        """
        if points_mm is None:
            return None
        now_mm = distances_mm(points_mm)
        if self._last_mm is None or self._lowest_mm is None or self._highest_mm is None:
            self._lowest_mm = self._highest_mm = now_mm
        else:
            is_followed = not self._is_doubted and timestamp_us - self._seen_us <= MAX_HIDDEN_US
            low_mm, high_mm = (self._last_mm, self._last_mm) if is_followed else (self._lowest_mm, self._highest_mm)
            for low, now, high in zip(low_mm, now_mm, high_mm, strict=True):
                if not max(low - now, now - high, 0.0) <= MARGIN_MM:  # also for NaN
                    self._is_doubted = True
                    detail = _rescaled(low_mm, now_mm, high_mm) or _described(low_mm, now_mm, high_mm)
                    return Lost(reason=LostReason.LAYOUT_CHANGED, detail=detail)
            self._lowest_mm = tuple(map(min, self._lowest_mm, now_mm))
            self._highest_mm = tuple(map(max, self._highest_mm, now_mm))
        self._last_mm, self._seen_us, self._is_doubted = now_mm, timestamp_us, False
        return None


def distances_mm(points_mm: FloatArray) -> Distances:
    """Return the six distances between four points, shape (4, 3) [mm], in the order of `PAIRS`."""
    places = points_mm.tolist()
    return tuple(map(math.dist, _ONES(places), _OTHERS(places)))


def _rescaled(low_mm: Distances, now_mm: Distances, high_mm: Distances) -> str | None:
    """Name a change of all distances by one factor: no sticker moves so; None where it is none."""
    changes = [2.0 * now / (low + high) - 1.0 for low, now, high in zip(low_mm, now_mm, high_mm, strict=True)]
    middle = sum(changes) / len(changes)
    if not (abs(middle) >= LEAST_RESCALED and all(abs(one - middle) <= 0.5 * abs(middle) for one in changes)):
        return None
    return say(
        "all distances between the markers changed by {middle:+.1%}: "
        "the depth scale of the camera has changed: check the camera",
        middle=middle,
    )


def _described(low_mm: Distances, now_mm: Distances, high_mm: Distances) -> str:
    """Name the marker whose distances to the three others changed most in sum, and their largest change."""
    beyond_mm = [max(low - now, now - high, 0.0) for low, now, high in zip(low_mm, now_mm, high_mm, strict=True)]
    sums = [sum(beyond for beyond, pair in zip(beyond_mm, PAIRS, strict=True) if marker in pair) for marker in range(4)]
    return say(
        "a distance of the {corners} marker is {beyond_mm:.0f} mm beyond its range: "
        "put the marker back, or set the reference again",
        corners=CORNERS[sums.index(max(sums))],
        beyond_mm=max(beyond_mm),
    )
