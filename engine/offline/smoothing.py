"""Smooths the motion of a recording over the frames around each: a session cannot, as it does not know the next ones.

A parabola is fitted to the measured frames within a tenth of a second on either side. It keeps what a breath or a cough
does and takes off nearly half of the noise from frame to frame. A lost frame ends the stretch that is fitted, and so
does a change of doubt: the step of a couch is no motion of the frames before it.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from engine.core.frames import FloatArray, Measurement, Motion, frozen
from engine.gating.gate import Gate

HALF_US = 105_000
"""Half of the time that is fitted: three frames on either side at 30 a second."""
LEAST_FRAMES = 5


class _Waiting(NamedTuple):
    measurement: Measurement
    decided: Gate


class MotionSmoother:
    """Passes measurements on in their order, each once the frames behind it are known.

    Parameters
    ----------
    emit
        Takes each measurement with its smoothed motion, and what the gate decided on the frame itself.
    is_smoothing
        Whether to smooth; otherwise everything is passed on at once.
    """

    def __init__(self, emit: Callable[[Measurement, Gate], None], *, is_smoothing: bool) -> None:
        self._emit, self._is_smoothing = emit, is_smoothing
        self._kept: deque[_Waiting] = deque()
        self._done = 0

    def add(self, measurement: Measurement, decided: Gate) -> None:
        """Take the next frame."""
        if not self._is_smoothing:
            self._emit(measurement, decided)
            return
        self._kept.append(_Waiting(measurement, decided))
        self._emit_before(measurement.timestamp_us - HALF_US)

    def finish(self) -> None:
        """Pass on what waits for frames that do not come."""
        if self._kept:
            self._emit_before(self._kept[-1].measurement.timestamp_us + 1)

    def _emit_before(self, time_us: int) -> None:
        kept = self._kept
        while self._done < len(kept) and kept[self._done].measurement.timestamp_us < time_us:
            self._emit(_smoothed(kept, self._done), kept[self._done].decided)
            self._done += 1
        while self._done and kept[0].measurement.timestamp_us < kept[self._done - 1].measurement.timestamp_us - HALF_US:
            kept.popleft()
            self._done -= 1


def _smoothed(kept: deque[_Waiting], at: int) -> Measurement:
    """Return a measurement with the motion of the parabola through its neighbours."""
    found = kept[at].measurement
    if found.motion is None:
        return found
    first, last = at, at
    while first > 0 and _belongs(kept[first - 1].measurement, found):
        first -= 1
    while last + 1 < len(kept) and _belongs(kept[last + 1].measurement, found):
        last += 1
    around = [kept[number].measurement for number in range(first, last + 1)]
    motions = [one.motion for one in around if one.motion is not None]
    if len(motions) < LEAST_FRAMES:
        return found
    seconds = np.array([one.timestamp_us - found.timestamp_us for one in around]) * 1e-6
    powers = np.stack([np.ones_like(seconds), seconds, seconds**2])
    weights = np.linalg.solve(powers @ powers.T, np.array([1.0, 0.0, 0.0])) @ powers  # of the parabola at this frame
    return replace(found, motion=_combined(found.motion, motions, weights))


def _belongs(one: Measurement, found: Measurement) -> bool:
    """Whether a frame is fitted with another: near in time, measured, and doubted if and only if the other is."""
    is_alike = (one.doubt is None) == (found.doubt is None)
    return one.motion is not None and is_alike and abs(one.timestamp_us - found.timestamp_us) <= HALF_US


def _combined(motion: Motion, motions: list[Motion], weights: FloatArray) -> Motion:
    numbers = weights @ np.array([(one.whole_mm, one.thorax_mm, one.abdomen_mm, one.volume_l) for one in motions])
    whole_mm, thorax_mm, abdomen_mm, volume_l = numbers.tolist()

    def mean(values: list[FloatArray]) -> FloatArray:
        stacked = np.array(values)
        return frozen((weights @ stacked.reshape(len(stacked), -1)).reshape(stacked.shape[1:]))

    return replace(
        motion,
        whole_mm=whole_mm,
        thorax_mm=thorax_mm,
        abdomen_mm=abdomen_mm,
        volume_l=volume_l,
        regions_mm=mean([one.regions_mm for one in motions]),
        regions_depth_mm=mean([one.regions_depth_mm for one in motions]),
        points_mm=mean([one.points_mm for one in motions]),
        named_mm=mean([one.named_mm for one in motions]),
    )
