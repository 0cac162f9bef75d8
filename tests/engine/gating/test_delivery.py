"""No stream ages unnoticed, whatever the camera's clock does; and no honest camera is held.

The age of each picture is known here; it is compared with what the gate believes.
"""

import math
import random
from dataclasses import replace
from itertools import accumulate

import pytest
from hypothesis import example, given, settings, strategies as st

from engine.core.gate_state import HoldReason
from engine.gating.delivery import FRESH_NS, MAX_RATE_ERROR_PPM, ClockRate, followed_rate
from tests.support.gating.ageing import SPARSE, STEP_NS, S, watched
from tests.support.gating.streams import LIMITS, MS, checked, followed_frame, measured

HOUR_S = 3_600.0
PPM = 1e-6
WIDE = replace(SPARSE, max_lag_ms=500.0)
"""A site that bears 500 ms: then only what is not seen is bounded more tightly."""

errors = st.one_of(st.sampled_from([-0.01, -0.005, 0.0, 0.005, 0.01]), st.floats(-0.01, 0.01))
legs = st.lists(st.tuples(st.floats(2.0, 60.0), st.floats(-0.05, 0.05)), min_size=1, max_size=5)
"""How a queue grows or drains: seconds, and milliseconds a millisecond."""


def path_of(legs):
    """Return how long a frame waits at a second: along the legs, never less than nothing."""
    ends_s = list(accumulate(seconds for seconds, _ in legs))
    waits_ms = [0.0]
    for seconds, slope in legs:
        waits_ms.append(max(waits_ms[-1] + 1e3 * slope * seconds, 0.0))

    def waiting_ms(at_s):
        for begun_s, ends, before_ms, (_, slope) in zip([0.0, *ends_s], ends_s, waits_ms, legs, strict=False):
            if at_s < ends:
                return max(before_ms + 1e3 * slope * (at_s - begun_s), 0.0)
        return waits_ms[-1]

    return waiting_ms, ends_s[-1]


def growing(slope, from_s=10.0):
    """Nothing waits at first, then ever more does."""
    return lambda at_s: 1e3 * slope * max(at_s - from_s, 0.0)


@settings(deadline=None, max_examples=40)
@given(error=errors, legs=legs)
@example(error=0.005, legs=[(10.0, 0.0), (120.0, 0.005)])
@example(error=0.01, legs=[(10.0, 0.0), (120.0, 0.01)])
@example(error=-0.01, legs=[(10.0, 0.0), (120.0, 0.01)])
@example(error=0.01, legs=[(120.0, 0.01)])
def test_no_believed_picture_is_older_than_the_lag_limit_for_any_clock_and_any_backlog(error, legs):
    waiting_ms, seconds = path_of(legs)
    stream = watched(seconds=seconds, clock_error=error, waiting_ms=waiting_ms)
    assert max((one.age_ms for one in stream if one.is_believed), default=0.0) <= SPARSE.max_lag_ms + 0.1


@settings(deadline=None, max_examples=40)
@given(error=errors, legs=legs)
@example(error=0.01, legs=[(10.0, 0.0), (120.0, 0.01)])
@example(error=0.01, legs=[(10.0, 0.0), (60.0, 0.012)])
def test_no_believed_picture_is_much_older_than_the_clocks_show_whatever_lag_a_site_allows(error, legs):
    waiting_ms, seconds = path_of(legs)
    stream = watched(seconds=seconds, clock_error=error, waiting_ms=waiting_ms, limits=WIDE)
    hidden_ms = max((one.age_ms - one.shown_ms for one in stream if one.is_believed), default=0.0)
    assert hidden_ms <= 5.05 + 0.1  # half a second of a clock that is wrong by one per cent


@pytest.mark.parametrize("error", [-0.01, -200 * PPM, -100 * PPM, 0.0, 28 * PPM, 100 * PPM, 490 * PPM, 0.005, 0.01])
def test_within_an_hour_no_stream_ages_by_more_than_100_ms_unnoticed(error):
    """The queue grows by as much as the clock is fast, the worst there is, and by at least 28 ms in 1000 s."""
    stream = watched(seconds=HOUR_S, clock_error=error, waiting_ms=growing(max(error, 28 * PPM), from_s=300.0))
    assert max(one.age_ms for one in stream if one.is_believed) <= 100.0


def test_a_backlog_that_a_fast_clock_hides_holds_within_half_a_second_and_states_since_when():
    stream = list(watched(seconds=20.0, clock_error=0.005, waiting_ms=growing(0.005)))
    believed = [one for one in stream if one.is_believed]
    assert 10.0 < believed[-1].at_s < 10.6
    assert {one.reason for one in stream if one.at_s > 10.6} == {HoldReason.FRAME_LATE}
    assert stream[-1].verdict.detail.startswith("9.9 s since a frame that is known to be fresh: up to 100 ms late")


def test_a_source_that_never_knows_is_not_believed():
    stream = watched(seconds=60.0, clock_error=0.0, waiting_ms=lambda _at_s: 0.0, has_proof=False)
    assert {one.reason for one in stream} == {HoldReason.FRAME_LATE}


@pytest.mark.parametrize("growth_ppm", [90.0, 150.0, 250.0])
def test_frames_that_wait_where_no_one_sees_it_are_hidden_at_the_drift_of_quartz_and_no_faster(growth_ppm):
    """What the least lag follows is the allowed drift; all beyond it shows as lag and holds."""
    stream = watched(
        seconds=HOUR_S / 2, clock_error=0.0, waiting_ms=growing(growth_ppm * PPM, from_s=0.0), is_proof_wrong=True
    )
    for one in stream:
        hidden_ms = one.age_ms - one.shown_ms
        assert hidden_ms <= 1e3 * min(growth_ppm, 101.0) * PPM * one.at_s + 0.1
        assert not one.is_believed or one.shown_ms <= SPARSE.max_lag_ms


def test_a_recording_needs_no_proof():
    stream = watched(
        seconds=HOUR_S,
        clock_error=0.01,
        waiting_ms=growing(0.01),
        has_proof=False,
        limits=replace(SPARSE, is_played=True),
    )
    assert {one.reason for one in stream} <= {None}


@pytest.mark.parametrize("busy_s", [0.4, 1.0])
@pytest.mark.parametrize("error", [-100 * PPM, 100 * PPM])
def test_an_honest_camera_is_held_for_hours_only_while_the_host_is_late_for_more_than_half_a_second(error, busy_s):
    """Jitter of 3 ms, and once a minute the host reads late for a while: then frames are late, as they are."""
    random_ms = random.Random(7)

    def waiting_ms(at_s):
        into_s = at_s % 60.0 - 30.0
        return 1e3 * max(1.0 - into_s, 0.0) * 0.04 if 0.0 <= into_s < busy_s else 0.0

    stream = watched(
        seconds=2 * HOUR_S,
        clock_error=error,
        waiting_ms=waiting_ms,
        jitter_ms=lambda _index: abs(random_ms.gauss(0.0, 3.0)),
    )
    held = [one for one in stream if one.reason is not None]
    assert {one.reason for one in held} <= {HoldReason.FRAME_LATE}
    assert all(30.4 < one.at_s % 60.0 < 31.1 for one in held)
    assert bool(held) is (busy_s > 0.5)


@pytest.mark.parametrize("error", [-100 * PPM, 100 * PPM])
def test_a_camera_that_returns_after_minutes_is_believed_from_its_second_frame_on(error):
    stream = watched(
        seconds=600.0, clock_error=error, waiting_ms=lambda _at_s: 0.0, is_away=lambda at_s: 200.0 < at_s < 400.0
    )
    assert [(one.at_s, one.reason) for one in stream if not one.is_believed] == [
        (pytest.approx(400.0, abs=0.2), HoldReason.FRAME_MISSING)
    ]


@pytest.mark.parametrize(
    ("error_ppm", "way"), [(400.0, "faster"), (-400.0, "slower"), (210.0, "faster"), (190.0, None), (-190.0, None)]
)
def test_a_clock_that_runs_at_a_wrong_rate_faults_within_a_little_more_than_two_minutes(error_ppm, way):
    stream = list(watched(seconds=140.0, clock_error=error_ppm * PPM, waiting_ms=lambda _at_s: 0.0, limits=WIDE))
    faults = [one for one in stream if one.reason is HoldReason.CLOCK_JUMPED]
    assert bool(faults) is (way is not None)
    if faults:
        assert 120.0 < faults[0].at_s < 131.0
        assert faults[0].verdict.reason.is_fault
        assert f"{abs(error_ppm):.0f} ppm {way} than the host's, {MAX_RATE_ERROR_PPM:g} allowed" in (
            faults[0].verdict.detail
        )


@settings(deadline=None, max_examples=40)
@given(step_ms=st.floats(-90.0, 90.0), at_s=st.floats(0.0, 300.0), error_ppm=st.floats(-100.0, 100.0))
def test_one_step_of_the_delay_is_no_rate(step_ms, at_s, error_ppm):
    rate = None
    for second in range(600):
        lag_ms = (step_ms if second > at_s else 0.0) - error_ppm * PPM * 1e3 * second
        rate = followed_rate(rate, second * S, int(lag_ms * MS))
        assert rate.error_ppm is None or abs(rate.error_ppm) <= 101.0


@given(st.lists(st.integers(-(10**9), 10**9), min_size=13, max_size=13))
def test_the_rate_is_the_lower_of_two_minutes_and_none_where_they_disagree(least_lags_ns):
    first, second = least_lags_ns[6] - least_lags_ns[0], least_lags_ns[12] - least_lags_ns[6]
    found = ClockRate(begun_ns=0, least_lag_ns=0, least_lags_ns=tuple(least_lags_ns)).error_ppm
    if first * second <= 0:
        assert found == 0.0
    else:
        assert found == pytest.approx(-math.copysign(min(abs(first), abs(second)), first) / 60e3)


def test_a_gap_restarts_the_estimate_of_the_rate_and_not_the_proof():
    frame = replace(measured(0), queue_empty_ns=measured(0).received_ns)
    last = followed_frame(None, frame)
    later = replace(
        frame,
        frame_index=1,
        timestamp_us=frame.timestamp_us + 2_000_000,
        received_ns=frame.received_ns + 2 * S,
    )
    after = followed_frame(last, later).delivery
    assert (after.rate.begun_ns, after.fresh_ns) == (later.received_ns, frame.received_ns)


def test_a_clock_that_restarts_needs_a_fresh_frame_before_it_is_believed_again():
    frame = replace(measured(5), queue_empty_ns=measured(5).received_ns)
    last = followed_frame(None, frame)
    restarted = replace(
        frame,
        frame_index=6,
        timestamp_us=10,
        received_ns=frame.received_ns + 100 * MS,
        queue_empty_ns=frame.received_ns,
    )
    assert followed_frame(last, restarted).delivery.fresh_ns is None


@pytest.mark.parametrize(
    ("empty_before_ns", "is_fresh"), [(0, True), (FRESH_NS, True), (FRESH_NS + 1, False), (-1, False), (None, False)]
)
def test_a_frame_is_fresh_if_the_queue_was_empty_just_before_it(empty_before_ns, is_fresh):
    frame = measured(0)
    empty_ns = None if empty_before_ns is None else frame.received_ns - empty_before_ns
    verdict = checked(None, replace(frame, queue_empty_ns=empty_ns), frame.received_ns + MS, LIMITS)
    assert (verdict is None) is is_fresh


def test_the_steps_of_these_streams_are_within_the_gate_s_longest_gap():
    assert SPARSE.max_gap_ms * MS > STEP_NS
