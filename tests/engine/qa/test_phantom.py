"""What a phantom tells, on frames whose motion and timing are known."""

from dataclasses import replace

import numpy as np
import pytest

from engine.capture.source import SourceDescription
from engine.core.errors import InvalidValueError
from engine.core.frames import MeasurementState
from engine.offline.offline_gate import Edge
from engine.qa.checks import check_of
from engine.qa.phantom import (
    GATE_CODES,
    MAX_POINTS,
    MOTION_CODES,
    _dwells_us,
    _measure_frames,
    figures_of,
    joined,
    measure_phantom,
    run_of,
    series_of,
)
from engine.qa.playing import opened
from engine.qa.sine import find_cycles
from engine.qa.trace import CommandedTrace, read_commanded
from lab.virtual_qa import AMPLITUDE_MM, PERIODS_S, virtual_phantom
from tests.support.qa.phantom_frames import watched
from tests.support.repository import DATA

pytestmark = [pytest.mark.slow, pytest.mark.verification]

ROBOT = DATA / "qa" / "LiverTraj_LargeSIandAP70s_robot.txt"
FRAME_MS = 1e3 / 29.97
HOST_AHEAD_NS = 7_000_000_000_000
DESCRIPTION = SourceDescription(
    kind="virtual", name="virtual", depth_size=(320, 240), color_size=(320, 240), fps=29.97, is_live=False
)


@pytest.fixture(scope="module")
def phantom():
    return virtual_phantom()


def calls(given, frames):
    return {figure.code: figure for figure in figures_of(given, run_of(given, frames))}


def values(given, frames):
    return {code: figure.value for code, figure in calls(given, frames).items()}


def test_a_perfect_phantom_has_no_error_and_a_gate_that_is_half_a_frame_late(phantom):
    found = values(*watched(phantom))
    assert found["motion_offset_mm"] == pytest.approx(0.0, abs=0.01)
    assert found["motion_error_mm"] == pytest.approx(0.0, abs=0.01)
    assert found["motion_amplitude_ratio"] == pytest.approx(1.0, abs=1e-3)
    assert found["motion_lag_ms"] == pytest.approx(0.0, abs=1.0)
    assert found["motion_lost_percent"] == 0.0
    assert found["gate_mean_delay_ms"] == pytest.approx(FRAME_MS / 2.0 + 2.0, abs=10.0)
    assert found["gate_delay_difference_ms"] == pytest.approx(0.0, abs=30.0)
    assert found["duty_cycle_change_percent"] == pytest.approx(0.0, abs=0.5)


@pytest.mark.parametrize("dwell_ms", [70.0, 100.0, 300.0])
def test_a_dwell_is_no_delay_and_no_duty(phantom, dwell_ms):
    given = replace(phantom, limits=replace(phantom.limits, dwell_ms=dwell_ms))
    found = values(*watched(given))
    assert found["gate_delay_on_ms"] == pytest.approx(FRAME_MS / 2.0 + 2.0, abs=20.0)
    assert found["gate_delay_off_ms"] == pytest.approx(FRAME_MS / 2.0 + 2.0, abs=20.0)
    assert found["duty_cycle_change_percent"] == pytest.approx(0.0, abs=0.5)


@pytest.mark.parametrize(
    ("dwelt_ms", "counted_ms"),
    [(100.1, 100.1), (133.0, 133.0), (300.0, 100.0 + FRAME_MS), (20.0, 100.0), (None, 100.0)],
)
def test_what_a_gate_dwells_beyond_its_dwell_and_a_frame_or_less_than_it_is_its_own_doing(
    phantom, dwelt_ms, counted_ms
):
    given, frames = watched(phantom)
    edge = Edge(at_us=0.0, is_on=True, dwelt_us=None if dwelt_ms is None else 1e3 * dwelt_ms)
    assert _dwells_us(given, [edge], frames) == pytest.approx([1e3 * counted_ms], abs=20.0)


def test_an_interval_that_began_before_or_ends_after_is_none():
    on, off, again = Edge(at_us=1.0, is_on=True), Edge(at_us=2.0, is_on=False), Edge(at_us=3.0, is_on=True)
    assert joined([off, on, off, again]) == [(on, off)]
    assert joined([]) == []


@pytest.mark.parametrize("computing_ms", [10.0, 40.0])
def test_computing_time_is_a_delay_of_the_gate_and_none_of_the_motion(phantom, computing_ms):
    given, frames = watched(phantom, computing_ns=np.full(10_000, computing_ms * 1e6))
    found = values(given, frames)
    assert found["gate_mean_delay_ms"] == pytest.approx(FRAME_MS / 2.0 + computing_ms, abs=10.0)
    assert found["motion_lag_ms"] == pytest.approx(0.0, abs=1.0)


def test_a_measurement_that_once_stays_inside_for_half_a_second_is_a_beam_that_was_on_outside_for_so_long(phantom):
    plain = values(*watched(phantom))["beam_outside_ms"]
    assert 0.0 < plain < FRAME_MS + 20.0
    given, _ = watched(phantom)
    crosses_s = find_cycles(given.trace, given.window_mm, 20.0, 60.0)[3].off_s

    def stays(time_s):
        is_stuck = (time_s > crosses_s - 0.05) & (time_s < crosses_s + 0.5)
        at_the_edge_mm = given.trace.at(np.array([crosses_s - 0.05]))[0]
        return np.where(is_stuck, at_the_edge_mm - given.trace.at(time_s), 0.0)

    found = values(*watched(phantom, error_mm=stays))
    assert found["beam_outside_ms"] == pytest.approx(500.0, abs=FRAME_MS + 5.0)
    assert abs(found["gate_delay_off_ms"]) < 80.0  # the sine method leaves it out


def test_a_beam_that_never_goes_off_again_is_outside_until_the_recording_ends(phantom):
    left_s = PERIODS_S[-1] / 4.0
    crosses_s = phantom.trace.span_s[1] - left_s

    def stays(time_s):
        return np.where(time_s > crosses_s - 0.05, AMPLITUDE_MM - 1.0 - phantom.trace.at(time_s), 0.0)

    found = values(*watched(phantom, error_mm=stays))
    assert found["beam_outside_ms"] == pytest.approx(1e3 * left_s, abs=FRAME_MS + 25.0)


def arriving(frames, lag_ms, *, drift=0.0):
    """The same frames, the n-th of them ``lag_ms(n)`` after it was taken, none before the one before it."""
    late, before_ns = [], 0
    for number, frame in enumerate(frames):
        taken_ns = round((1.0 + drift) * 1e3 * frame.measurement.timestamp_us) + HOST_AHEAD_NS
        before_ns = max(taken_ns + round(lag_ms(number) * 1e6), before_ns + 1000)
        received = replace(frame.measurement, received_ns=before_ns, queue_empty_ns=before_ns)
        late.append(replace(frame, measurement=received))
    return late


def mostly_late_ms(number):
    """70 ms late, but for a few frames every two seconds; no step that would hold the gate."""
    return 5.0 + min(25.0 * min(number % 60, -number % 60), 70.0)


def live(given, frames):
    found = figures_of(given, run_of(given, frames, is_live=True))
    return {figure.code: figure.value for figure in found}


@pytest.mark.parametrize("drift", [0.0, 1e-4, -1e-4])
def test_a_live_phantom_s_prompt_frames_tell_what_a_recording_s_do_whatever_the_host_s_clock(phantom, drift):
    given, frames = watched(phantom)
    found, recorded = live(given, arriving(frames, lambda _number: 5.0, drift=drift)), values(given, frames)
    for code in GATE_CODES:
        assert found[code] == pytest.approx(recorded[code], abs=1.5)


def test_what_a_live_phantom_s_frames_take_to_arrive_is_a_delay_of_the_gate_and_of_a_recording_s_it_is_none(phantom):
    given, frames = watched(phantom)
    plain = values(given, frames)
    late = arriving(frames, mostly_late_ms)
    found = live(given, late)
    for code in ("gate_mean_delay_ms", "gate_delay_off_ms", "beam_outside_ms"):
        assert found[code] - plain[code] == pytest.approx(70.0, abs=12.0)
    assert values(given, late) == plain


def test_a_live_phantom_of_which_every_second_frame_is_far_too_late_does_not_pass(phantom):
    given, frames = watched(phantom)
    found = live(given, arriving(frames, lambda number: 5.0 + 400.0 * (number % 2)))
    assert all(found[code] is None for code in GATE_CODES)


def test_a_live_phantom_s_frames_that_come_later_than_the_gate_bears_hold_it_as_they_do_in_a_session(phantom):
    given, frames = watched(phantom)
    most_ms = given.limits.max_lag_ms

    def later(beyond_ms):
        return live(given, arriving(frames, lambda number: 5.0 + (most_ms + beyond_ms) * min(number % 450 / 8, 1.0)))

    assert later(-30.0)["gate_delay_off_ms"] > 60.0
    assert later(40.0)["gate_delay_off_ms"] is None


def test_a_fault_before_the_gate_was_armed_is_none_of_a_live_phantom_s(phantom):
    given, frames = watched(phantom)
    found = live(given, arriving(frames, lambda number: 705.0 if number == 50 else 5.0))
    assert found["gate_delay_off_ms"] == pytest.approx(values(given, frames)["gate_delay_off_ms"], abs=1.5)


@pytest.mark.parametrize("is_live", [False, True])
def test_a_source_states_itself_whether_it_is_live(phantom, monkeypatch, is_live):
    given, frames = watched(phantom)
    late = arriving(frames, mostly_late_ms)
    monkeypatch.setattr("engine.qa.phantom._measure_frames", lambda *_given, **_named: (late, None))
    monkeypatch.setattr(given.source, "open", lambda: replace(DESCRIPTION, is_live=is_live))
    found = {figure.code: figure.value for figure in measure_phantom(given, lambda _frames: None)[0]}
    assert (found["gate_delay_off_ms"] > 70.0) is is_live


@pytest.mark.parametrize("code", [code for code in GATE_CODES if code.endswith("_ms")] + ["beam_off_total_ms"])
def test_the_method_states_that_a_recording_has_no_transport_in_it(code):
    assert "recording" in check_of(code).method


@pytest.mark.parametrize("delay_ms", [60.0, 150.0])
def test_a_delay_of_the_picture_is_a_lag_and_a_delay_of_the_gate_on_and_off(phantom, delay_ms):
    found = values(*watched(phantom, delay_s=delay_ms / 1e3))
    late_ms = delay_ms + FRAME_MS / 2.0 + 2.0
    assert found["motion_lag_ms"] == pytest.approx(delay_ms, abs=1.5)
    assert found["motion_offset_mm"] == pytest.approx(0.0, abs=0.05)
    for code in ("gate_mean_delay_ms", "gate_delay_on_ms", "gate_delay_off_ms"):
        assert found[code] == pytest.approx(late_ms, abs=20.0)
    assert found["duty_cycle_change_percent"] == pytest.approx(0.0, abs=0.5)


def test_what_the_camera_itself_takes_is_in_the_lag_and_in_the_gate(phantom):
    late = replace(phantom, limits=replace(phantom.limits, camera_latency_ms=50.0))
    plain, found = values(*watched(phantom)), values(*watched(late))
    assert found["motion_lag_ms"] - plain["motion_lag_ms"] == pytest.approx(50.0, abs=1.0)
    assert found["gate_mean_delay_ms"] - plain["gate_mean_delay_ms"] == pytest.approx(50.0, abs=8.0)
    assert found["motion_offset_mm"] == pytest.approx(0.0, abs=0.02)


def test_the_trace_s_time_0_is_the_first_frame_s_unless_it_is_given(phantom):
    given, frames = watched(phantom, phase_s=0.12)
    assert values(given, frames)["motion_lag_ms"] == pytest.approx(0.0, abs=1.0)
    assert values(replace(given, starts_us=None), frames)["motion_lag_ms"] == pytest.approx(-120.0, abs=1.5)


@pytest.mark.parametrize("offset_mm", [-1.0, 1.0])
def test_a_level_that_is_off_keeps_its_sign_in_the_offset_and_in_the_duty(phantom, offset_mm):
    found = values(*watched(phantom, error_mm=lambda time_s: np.where(time_s > 15.5, offset_mm, 0.0)))
    assert found["motion_offset_mm"] == pytest.approx(offset_mm, abs=0.05)
    # The window is below: what lies higher is inside for less of a cycle.
    assert found["duty_cycle_change_percent"] == pytest.approx(-3.19 * offset_mm, abs=0.5)
    assert found["gate_mean_delay_ms"] == pytest.approx(FRAME_MS / 2.0 + 2.0, abs=12.0)


def test_a_window_from_above_is_timed_as_well(phantom):
    given = replace(phantom, window_mm=(10.0, 60.0))
    found = values(*watched(given, delay_s=0.1))
    assert found["gate_mean_delay_ms"] == pytest.approx(100.0 + FRAME_MS / 2.0 + 2.0, abs=12.0)
    assert found["duty_cycle_change_percent"] == pytest.approx(0.0, abs=0.6)


def test_frames_that_give_no_motion_are_counted_after_the_reference_only(phantom):
    given, frames = watched(phantom, lost=range(1000, 1050))
    after = sum(frame.measurement.state is not MeasurementState.TRAINING for frame in frames)
    assert values(given, frames)["motion_lost_percent"] == pytest.approx(100.0 * 50 / after)


def test_a_patient_s_trace_reports_the_motion_and_states_that_it_cannot_report_of_the_gate(phantom):
    trace = read_commanded(ROBOT)
    middle_mm = float(np.mean(trace.reach_mm))
    given = replace(phantom, trace=trace, window_mm=(-60.0, middle_mm))
    found = calls(*watched(given))
    assert all(found[code].value is not None for code in MOTION_CODES)
    assert found["motion_error_mm"].value < 0.05
    assert all(found[code].value is None and "sines" in found[code].detail for code in GATE_CODES)


def test_a_phantom_that_is_never_measured_is_a_sentence(phantom):
    given, frames = watched(phantom)
    training = [frame for frame in frames if frame.measurement.state is MeasurementState.TRAINING]
    assert "not enough to learn" in run_of(given, training)
    assert "empty" in run_of(given, [])
    assert "hidden" in run_of(given, [watched(phantom, lost=range(10_000))[1][-1]])


def test_a_zero_outside_of_the_trace_is_a_sentence(phantom):
    given, frames = watched(phantom)
    assert "outside" in run_of(replace(given, starts_us=10**12), frames)


def test_a_plot_s_curves_are_as_long_as_each_other_thin_and_finite(phantom):
    given, frames = watched(phantom)
    drawn = series_of(given, run_of(given, frames))
    assert [series.code for series in drawn] == ["commanded_measured", "gate_intervals", "gate_lengths"]
    for series in drawn:
        for curve in series.curves:
            assert 0 < len(curve.x) == len(curve.y) <= MAX_POINTS
            assert np.isfinite([curve.x, curve.y]).all()
    on, off = drawn[1].curves[2:]
    dwelt = np.array(on.y) - np.array(drawn[1].curves[0].y)
    assert 100.0 < dwelt.mean() < 190.0  # as it was, dwell and all
    assert (np.array(off.y) > 0.0).all()


@pytest.mark.parametrize(
    "window_mm", [(5.0, 15.0), (-50.0, 50.0), (10.0, -50.0), (-60.0, float("nan")), (-200.0, 10.0)]
)
def test_a_window_that_states_nothing_of_timing_is_refused(phantom, window_mm):
    with pytest.raises(InvalidValueError, match=r"phantom\.window_mm"):
        replace(phantom, window_mm=window_mm)


def test_a_trace_of_another_amplitude_is_reported_as_a_ratio(phantom):
    given, frames = watched(phantom)
    larger = CommandedTrace(time_s=given.trace.time_s.copy(), position_mm=1.25 * given.trace.position_mm)
    found = values(replace(given, trace=larger, window_mm=(-60.0, 12.5)), frames)
    assert found["motion_amplitude_ratio"] == pytest.approx(0.8, abs=0.005)


def test_the_reference_is_the_proposed_one_the_mean_of_the_ends_of_exhale():
    """As in a session; it was the position of the first measured frame, with that frame's noise."""
    given = virtual_phantom(seed=7, periods_s=(2.3,), cycles_each=3)
    with opened(given.source) as description:
        frames, proposed = _measure_frames(given, lambda _frames: None, is_live=description.is_live)
    assert proposed is not None
    assert proposed.exhales >= 2
    run = run_of(given, frames, proposed=proposed)
    assert run.reference_mm == pytest.approx(0.0, abs=0.05), "the lowest commanded position"
    assert run.time_s[0] == pytest.approx((proposed.at_us - frames[0].measurement.timestamp_us) / 1e6)
    assert run.agreement.offset_mm == pytest.approx(0.0, abs=0.25)
