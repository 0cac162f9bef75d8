"""The smoothed motion of a recording: what a body does is kept, noise is not, and no gap is bridged."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.frames import Lost, LostReason, MeasurementState
from engine.gating.gate import Gate
from engine.offline.smoothing import MotionSmoother
from tests.support.gating.streams import measured as measurement, motion_of

FRAME_US = 33_367


def stream(values, lost=()):
    """Measurements at 30 frames a second with this whole motion, some of them lost."""
    found = []
    for index, value in enumerate(values):
        measured = replace(measurement(index, motion_of(float(value))), timestamp_us=index * FRAME_US)
        if index in lost:
            why = Lost(reason=LostReason.MARKER_LOST, detail="3 of 4 markers found")
            measured = replace(measured, state=MeasurementState.LOST, motion=None, lost=why)
        found.append(measured)
    return found


def smoothed(measurements, *, is_smoothing=True):
    """What comes out, in order."""
    found = []
    smoother = MotionSmoother(lambda one, gate: found.append((one, gate)), is_smoothing=is_smoothing)
    for one in measurements:
        smoother.add(one, Gate())
    smoother.finish()
    return [one for one, _ in found]


def whole(measurements):
    return np.array([np.nan if one.motion is None else one.motion.whole_mm for one in measurements])


def test_every_frame_comes_out_once_and_in_order_with_what_the_gate_decided_on_it():
    gates = [Gate() for _ in range(40)]
    found = []
    smoother = MotionSmoother(lambda one, gate: found.append((one.frame_index, gate)), is_smoothing=True)
    for one, gate in zip(stream(np.zeros(40), lost={7, 8}), gates, strict=True):
        smoother.add(one, gate)
    smoother.finish()
    assert [index for index, _ in found] == list(range(40))
    assert all(gate is own for (_, gate), own in zip(found, gates, strict=True))


def test_a_motion_that_bends_is_kept_to_the_last_bit_of_its_parabola():
    times = np.arange(60) * FRAME_US * 1e-6
    values = 3.0 - 8.0 * times + 12.0 * times**2
    assert whole(smoothed(stream(values))) == pytest.approx(values, abs=1e-9)


def test_breathing_and_a_cough_lose_hundredths_of_a_millimetre():
    times = np.arange(300) * FRAME_US * 1e-6
    breath = 10.0 * np.sin(2.0 * np.pi * times / 3.0)
    cough = 3.0 * np.exp(-(((times - 5.0) / 0.15) ** 2))
    assert np.abs(whole(smoothed(stream(breath))) - breath).max() < 0.02
    assert np.abs(whole(smoothed(stream(cough))) - cough).max() < 0.15


def test_noise_is_nearly_halved_but_for_the_two_ends():
    noise = np.random.default_rng(3).standard_normal(3000)
    left = whole(smoothed(stream(noise)))[3:-3]
    assert np.std(left) == pytest.approx(np.sqrt(1.0 / 3.0), rel=0.05)


def test_a_lost_frame_ends_the_stretch_and_stays_lost():
    values = np.concatenate([np.zeros(20), [np.nan], np.full(20, 5.0)])
    found = smoothed(stream(np.nan_to_num(values), lost={20}))
    assert found[20].motion is None
    assert whole(found)[:20] == pytest.approx(np.zeros(20), abs=1e-9)
    assert whole(found)[21:] == pytest.approx(np.full(20, 5.0), abs=1e-9)


def test_too_few_neighbours_and_a_pass_that_is_not_smoothed_leave_a_frame_as_it_is():
    values = np.random.default_rng(4).standard_normal(12)
    alone = stream(values, lost=set(range(0, 12, 5)))
    assert whole(smoothed(alone)) == pytest.approx(whole(alone), nan_ok=True)
    assert smoothed(stream(values), is_smoothing=False)[5].motion.whole_mm == values[5]
