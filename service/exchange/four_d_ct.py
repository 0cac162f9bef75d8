"""Breathing for 4-D CT: where in the breath each image lies, and how far the skin moves within each bin.

What sorts the images is a place in the breath from 0 to 1: 0 is the end of inhale, about 0.5 the end of exhale. It is
found in retrospect, from the ends of inhale on both sides, so it differs from the phase that a gate has at the time.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter1d
from scipy.signal import find_peaks

from engine.core.bounds import check_whole_number
from engine.core.errors import InvalidValueError
from engine.core.frames import FloatArray

SMOOTHING_S = 0.3
SHORTEST_BREATH_S = 1.2
LEAST_BREATH_MM = 0.8
DEPTH_SHARE = 0.3
"""A turn counts that stands out by this share of the range of 90 % of the values."""
LONGEST_BREATH_S = 15.0
BINS = (2, 20)


class Sorting(StrEnum):
    """What is equal between the bins.

    ``equal_time``: each has the same part of every breath's time. ``equal_amplitude``: of the range of 90 % of all
    values, falling and rising apart. ``local_amplitude``: of each breath's own range, falling and rising apart.
    """

    EQUAL_TIME = "equal_time"
    EQUAL_AMPLITUDE = "equal_amplitude"
    LOCAL_AMPLITUDE = "local_amplitude"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Breaths:
    """Turning points of a signal: indices of the ends of inhale and of the end of exhale between each two."""

    inhale: npt.NDArray[np.int64]
    exhale: npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Bin:
    """Values of one bin: its middle in the breath, its share of the time, and its motion [mm].

    ``residual_mm`` is the standard deviation within the bin, ``range_mm`` the width of 90 % of its values; None where
    no value lies in it.
    """

    number: int
    middle: float
    share: float
    mean_mm: float | None
    residual_mm: float | None
    range_mm: float | None


def breaths_of(time_s: FloatArray, motion_mm: FloatArray) -> Breaths:
    """Find the breaths of a curve.

    Raises
    ------
    InvalidValueError
        There are fewer than two ends of inhale.
    """
    known = np.isfinite(motion_mm)
    if known.sum() < 3:
        raise InvalidValueError("motion_mm", f"{int(known.sum())} values", "at least two breaths")
    filled = np.interp(time_s, time_s[known], motion_mm[known])
    rate = (len(time_s) - 1) / float(time_s[-1] - time_s[0])
    smooth = uniform_filter1d(filled, max(1, round(SMOOTHING_S * rate)))
    low, high = np.percentile(filled, (5.0, 95.0))
    least_mm = max(LEAST_BREATH_MM, DEPTH_SHARE * float(high - low))
    inhale, _ = find_peaks(smooth, prominence=least_mm, distance=max(1, round(SHORTEST_BREATH_S * rate)))
    if len(inhale) < 2:
        raise InvalidValueError("motion_mm", f"{len(inhale)} ends of inhale", "at least two breaths")
    exhale = [first + int(np.argmin(smooth[first:last])) for first, last in pairwise(inhale)]
    return Breaths(inhale=inhale.astype(np.int64), exhale=np.array(exhale, dtype=np.int64))


def places_in_breath(
    time_s: FloatArray, motion_mm: FloatArray, sorting: Sorting = Sorting.EQUAL_TIME, breaths: Breaths | None = None
) -> FloatArray:
    """Return the place in the breath of every value, from 0 to below 1; NaN where it is not known.

    It is not known before the first end of inhale and after the last, in a breath longer than 15 s, and for the
    amplitudes where the value itself is not known.

    Raises
    ------
    InvalidValueError
        There are fewer than two ends of inhale.
    """
    found = breaths_of(time_s, motion_mm) if breaths is None else breaths
    place = np.full(len(time_s), np.nan)
    low, high = np.nanpercentile(motion_mm, (5.0, 95.0))
    for first, turn, last in zip(found.inhale, found.exhale, found.inhale[1:], strict=False):
        if time_s[last] - time_s[first] > LONGEST_BREATH_S:
            continue
        breath = slice(first, last)
        if sorting is Sorting.EQUAL_TIME:
            place[breath] = (time_s[breath] - time_s[first]) / (time_s[last] - time_s[first])
            continue
        if sorting is Sorting.LOCAL_AMPLITUDE:
            low, high = np.nanmin(motion_mm[first : last + 1]), np.nanmax(motion_mm[first : last + 1])
        height = np.clip((motion_mm[breath] - low) / max(float(high - low), 1e-9), 0.0, 1.0)
        is_rising = np.arange(first, last) >= turn
        place[breath] = np.where(is_rising, 0.5 + 0.5 * height, 0.5 * (1.0 - height)) % 1.0
    return place


def at_times(time_s: FloatArray, place: FloatArray, image_s: FloatArray) -> FloatArray:
    """Return the place in the breath of images at other times [s], by the values on both sides; NaN where not known."""
    after = np.clip(np.searchsorted(time_s, image_s), 1, len(time_s) - 1)
    before = after - 1
    share = (image_s - time_s[before]) / (time_s[after] - time_s[before])
    step = (place[after] - place[before] + 0.5) % 1.0 - 0.5  # the shorter way round the end of inhale
    found = (place[before] + share * step) % 1.0
    return np.where((image_s < time_s[0]) | (image_s > time_s[-1]), np.nan, found)


def bins_of(motion_mm: FloatArray, place: FloatArray, count: int) -> list[Bin]:
    """Sort values into bins around 0, 1/count, 2/count and so on; return what each holds.

    Raises
    ------
    InvalidValueError
        ``count`` is out of its bounds.
    """
    check_whole_number("bins", count, *BINS)
    known = np.isfinite(place) & np.isfinite(motion_mm)
    number = np.full(len(place), -1)
    number[known] = np.rint(place[known] * count).astype(np.int64) % count
    return [_bin(one, count, motion_mm[number == one], int(known.sum())) for one in range(count)]


def _bin(number: int, count: int, values: FloatArray, known: int) -> Bin:
    mean = deviation = width = None
    if len(values):
        low, high = np.percentile(values, (5.0, 95.0))
        mean, deviation, width = float(values.mean()), float(values.std()), float(high - low)
    return Bin(
        number=number,
        middle=number / count,
        share=len(values) / known if known else 0.0,
        mean_mm=mean,
        residual_mm=deviation,
        range_mm=width,
    )


def phase_list(place: FloatArray) -> str:
    """Write places as RTK reads them: one value from 0 to below 1 a line.

    Raises
    ------
    InvalidValueError
        A place is not known: a projection without one would be sorted at random.
    """
    unknown = np.flatnonzero(~np.isfinite(place))
    if len(unknown):
        raise InvalidValueError("phase", f"not known for image {unknown[0] + 1} and {len(unknown) - 1} more", "known")
    return "".join(f"{value:.6f}\n" for value in np.minimum(place, 0.999999))


def bins_table(bins: Sequence[Bin]) -> str:
    """Write bins as CSV."""
    rows = [
        f"{one.number},{one.middle:.3f},{one.share:.4f},{_number(one.mean_mm)},{_number(one.residual_mm)},{_number(one.range_mm)}"
        for one in bins
    ]
    return "\n".join(["bin,middle,share,mean_mm,residual_mm,range_90_mm", *rows, ""])


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
