"""Distances between the markers in mm: a marker that comes off and is attached elsewhere marks another region.

Breathing changes the distances between the markers slowly and within a range; the skin stretches. So each distance is
followed while frames are measured, and its range is kept. From one frame to the next, and after an interval without a
measurement, every distance has to be within that range and a small margin.
"""

import itertools
import math

import numpy as np

from engine.core.compiled import kernels
from engine.core.frames import FloatArray, Lost, LostReason, RoiDepth
from engine.motion.tracking.surface_continuity import MAX_HIDDEN_US

NAMES = ("superior right", "superior left", "inferior left", "inferior right")
PAIRS = tuple(itertools.combinations(range(4), 2))
MARGIN_MM = 3.0
"""How far a distance may be outside of its range so far; a marker is found within some tenths of a millimetre."""

CORNER_PX = 20
LEAST_READINGS = 9
Distances = tuple[float, ...]


def marker_points_mm(rays: FloatArray, roi: RoiDepth) -> FloatArray | None:
    """Return the markers' places [mm], shape (4, 3): their rays, shape (4, 3), at the depth of the skin beside them.

    None where too little of the skin beside one of them is seen.
    """
    medians_mm = _corner_medians_mm(roi)
    return None if medians_mm is None else np.asarray(rays * medians_mm[:, None])


def _corner_medians_mm(roi: RoiDepth) -> FloatArray | None:
    """Return the median depth at the region's corners [mm], shape (4,); None where too little of one is seen."""
    reach = max(CORNER_PX // roi.stride_px, 1)
    compiled = kernels()
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
            beyond_mm = [
                max(low - now, now - high, 0.0) for low, now, high in zip(low_mm, now_mm, high_mm, strict=True)
            ]
            if not all(beyond <= MARGIN_MM for beyond in beyond_mm):  # also for NaN
                self._is_doubted = True
                return Lost(reason=LostReason.LAYOUT_CHANGED, detail=_described(tuple(beyond_mm)))
            self._lowest_mm = tuple(map(min, self._lowest_mm, now_mm))
            self._highest_mm = tuple(map(max, self._highest_mm, now_mm))
        self._last_mm, self._seen_us, self._is_doubted = now_mm, timestamp_us, False
        return None


def distances_mm(points_mm: FloatArray) -> Distances:
    """Return the six distances between four points, shape (4, 3) [mm], in the order of `PAIRS`."""
    places = points_mm.tolist()
    return tuple([math.dist(places[one], places[other]) for one, other in PAIRS])


def _described(beyond_mm: Distances) -> str:
    """Name the marker whose distances to the three others changed most in sum, and their largest change."""
    sums = [sum(beyond for beyond, pair in zip(beyond_mm, PAIRS, strict=True) if marker in pair) for marker in range(4)]
    return (
        f"a distance of the {NAMES[sums.index(max(sums))]} marker is {max(beyond_mm):.0f} mm beyond its range: "
        "put the marker back, or set the reference again"
    )
