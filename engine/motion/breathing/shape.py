"""The shape of a breath: height of the signal at each phase, 0 at the end of exhale, 1 at the end of inhale."""

from statistics import median

SHAPE_POINTS = 20
MIN_SEEN = 4
Path = tuple[tuple[float, float], ...]
"""Pairs of time [s], ascending, and level [mm]."""
Shape = tuple[float, ...]
"""Heights at equal steps of phase from 0 %, the end of inhale; periodic."""


def shape_of(path: Path, start_s: float, end_s: float, low: float, high: float) -> Shape | None:
    """Return the shape of the breath between two ends of inhale [s]; None if the path has too few points."""
    if len(path) < MIN_SEEN or not (end_s > start_s and high > low):
        return None
    heights, before = [], 0
    for number in range(SHAPE_POINTS):
        at_s = start_s + (end_s - start_s) * number / SHAPE_POINTS
        while before + 2 < len(path) and path[before + 1][0] <= at_s:
            before += 1
        (first_s, first), (next_s, following) = path[before], path[before + 1]
        share = min(max((at_s - first_s) / (next_s - first_s), 0.0), 1.0)
        heights.append((first + share * (following - first) - low) / (high - low))
    return tuple(heights)


def usual_shape(shapes: list[Shape]) -> Shape:
    """Return the median of one or more shapes at each phase."""
    return tuple(median(heights) for heights in zip(*shapes, strict=True))


def height_at(shape: Shape, percent: float) -> float:
    """Return the height at a phase [%], linearly interpolated; the phase may exceed 100."""
    place = (percent % 100.0) * len(shape) / 100.0
    before = int(place) % len(shape)
    share = place - int(place)
    return shape[before] + share * (shape[(before + 1) % len(shape)] - shape[before])
