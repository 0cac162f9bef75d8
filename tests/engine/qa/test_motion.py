"""Measured against commanded motion, with errors that are known."""

import numpy as np
import pytest

from engine.qa.motion import MIN_FRAMES, compare_motion
from engine.qa.trace import CommandedTrace

TIMES = np.arange(0.0, 60.0, 0.02)
TRACE = CommandedTrace(
    time_s=TIMES, position_mm=6.0 * np.sin(2.0 * np.pi * TIMES / 4.0) + 2.0 * np.sin(2.0 * np.pi * TIMES / 5.7)
)
FRAMES_S = np.arange(10.0, 50.0, 1.0 / 29.97)
ZERO_S = float(FRAMES_S[0])


def measured(*, lag_s=0.0, gain=1.0, offset_mm=0.0):
    return gain * (TRACE.at(FRAMES_S - lag_s) - TRACE.at(np.array([ZERO_S - lag_s]))) + offset_mm


def compared(motion_mm):
    return compare_motion(FRAMES_S, motion_mm, TRACE, ZERO_S)


def test_the_same_motion_has_no_error():
    found = compared(measured())
    assert (found.lag_s, found.offset_mm, found.mean_error_mm) == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert found.ratio == pytest.approx(1.0, abs=1e-4)
    assert found.frames == len(FRAMES_S)


@pytest.mark.parametrize("lag_s", [-0.12, 0.045, 0.15, 0.4])
def test_a_lag_is_found_with_its_sign_and_makes_no_error_beside(lag_s):
    found = compared(measured(lag_s=lag_s))
    assert found.lag_s == pytest.approx(lag_s, abs=1e-3)
    assert found.mean_error_mm < 0.02


@pytest.mark.parametrize("offset_mm", [-2.0, 2.0])
@pytest.mark.parametrize("lag_s", [0.0, 0.15])
def test_an_offset_keeps_its_sign_whatever_the_lag_and_an_error_has_none(offset_mm, lag_s):
    found = compared(measured(lag_s=lag_s, offset_mm=offset_mm))
    assert found.offset_mm == pytest.approx(offset_mm, abs=0.02)
    assert found.mean_error_mm == pytest.approx(2.0, abs=0.02)
    assert found.p95_error_mm == pytest.approx(2.0, abs=0.03)


def test_errors_that_cancel_are_errors_all_the_same():
    either = np.where(np.arange(len(FRAMES_S)) % 2 == 0, 1.5, -1.5)
    found = compared(measured() + either)
    assert found.offset_mm == pytest.approx(0.0, abs=0.01)
    assert found.mean_error_mm == pytest.approx(1.5, abs=0.01)


def test_the_95th_percentile_sees_what_the_mean_does_not():
    seldom = np.where(np.arange(len(FRAMES_S)) % 12 == 0, -5.0, 0.0)
    found = compared(measured() + seldom)
    assert found.mean_error_mm < 0.6
    assert found.p95_error_mm > 4.5


@pytest.mark.parametrize("gain", [0.9, 1.1])
def test_an_amplitude_is_reported_as_a_ratio_of_measured_to_commanded(gain):
    assert compared(measured(gain=gain)).ratio == pytest.approx(gain, abs=2e-3)


def test_too_few_frames_within_the_trace_tell_nothing():
    few = slice(0, MIN_FRAMES - 1)
    assert isinstance(compare_motion(FRAMES_S[few], measured()[few], TRACE, ZERO_S), str)
    assert isinstance(compare_motion(FRAMES_S + 100.0, measured(), TRACE, ZERO_S), str)


def test_a_zero_outside_of_the_trace_reports_nothing():
    assert "reference" in compare_motion(FRAMES_S, measured(), TRACE, -1.0)


def test_a_lag_beyond_all_reason_is_a_time_zero_that_is_not_known():
    slow = CommandedTrace(time_s=TIMES, position_mm=6.0 * np.sin(2.0 * np.pi * TIMES / 20.0))
    late = slow.at(FRAMES_S - 0.9) - slow.at(np.array([ZERO_S - 0.9]))
    assert "time 0" in compare_motion(FRAMES_S, late, slow, ZERO_S)


def test_nothing_that_stands_still_reports_anything():
    still = np.where(TIMES > 30.0, 3.0, 3.0 * np.sin(2.0 * np.pi * TIMES / 5.0))
    late = FRAMES_S > 35.0
    trace = CommandedTrace(time_s=TIMES, position_mm=still)
    assert "less than" in compare_motion(FRAMES_S[late], measured()[late], trace, ZERO_S)
    assert "constant" in compared(np.zeros_like(FRAMES_S))


@pytest.mark.parametrize("lag_s", [0.0, 0.15])
def test_a_reference_at_the_ends_of_exhale_is_the_mean_of_the_last_commanded_ones(lag_s):
    """Whatever the position was when it was set."""
    low_mm = TRACE.ends_of_exhale_mm(ZERO_S, 2)
    motion_mm = TRACE.at(FRAMES_S - lag_s) - low_mm
    found = compare_motion(FRAMES_S, motion_mm, TRACE, ZERO_S, 2)
    assert (found.lag_s, found.offset_mm) == pytest.approx((lag_s, 0.0), abs=2e-3)
    other = compare_motion(FRAMES_S, motion_mm + 1.0, TRACE, ZERO_S, 2)
    assert other.offset_mm == pytest.approx(1.0, abs=2e-3)


def test_fewer_commanded_ends_of_exhale_than_the_reference_has_are_stated():
    assert "fewer than 99 ends of exhale" in compare_motion(FRAMES_S, measured(), TRACE, ZERO_S, 99)


def test_the_ends_of_exhale_of_a_trace_are_its_low_positions_that_it_has_risen_from():
    time_s = np.arange(0.0, 24.0, 0.05)
    depth_mm = np.where(time_s < 16.0, 10.0, 12.0)
    trace = CommandedTrace(time_s=time_s, position_mm=depth_mm * np.cos(2.0 * np.pi * time_s / 4.0))
    assert trace.ends_of_exhale_mm(11.5, 2) == pytest.approx(-10.0, abs=0.05)
    assert trace.ends_of_exhale_mm(23.5, 2) == pytest.approx(-12.0, abs=0.05)
    assert trace.ends_of_exhale_mm(23.5, 3) == pytest.approx(-34.0 / 3.0, abs=0.05)
    assert np.isnan(trace.ends_of_exhale_mm(2.1, 1)), "the trace has hardly risen"
    assert np.isnan(trace.ends_of_exhale_mm(-1.0, 1))
