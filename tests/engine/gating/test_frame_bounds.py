"""One frame against the one before it: each bound just kept and just broken, with the words of the refusal."""

import math
from dataclasses import replace

import pytest

from engine.core.gate_state import HoldReason
from tests.support.gating.streams import (
    LEVEL_MM,
    LIMITS,
    MS,
    PERIOD_NS,
    PERIOD_US,
    checked,
    followed_frame,
    measured,
    motion_of,
)

BEFORE = followed_frame(None, measured(3))
NEXT = measured(4)
EASY = replace(LIMITS, max_gap_ms=200.0, max_silence_ms=300.0, max_latency_ms=1000.0, max_frame_age_ms=200.0)
PERIOD_MS = PERIOD_NS / MS


def refused(frame=NEXT, limits=LIMITS, *, age_ns=5 * MS, last=BEFORE):
    """Return reason and words of the refusal of a frame decided on so long after it came; None if it is good."""
    found = checked(last, frame, frame.received_ns + age_ns, limits)
    return None if found is None else (found.reason, found.detail)


def test_a_good_frame_is_refused_for_nothing():
    assert refused() is None
    assert refused(last=None) is None


@pytest.mark.parametrize(
    ("changes", "age_ns", "refusal"),
    [
        ({}, 0, None),
        ({}, -1, (HoldReason.CLOCK_BACKWARDS, "received 1 ns after now")),
        ({"frame_index": 3}, MS, (HoldReason.CLOCK_BACKWARDS, "frame 3 after frame 3")),
        (
            {"timestamp_us": BEFORE.timestamp_us},
            MS,
            (HoldReason.CLOCK_BACKWARDS, f"device time {BEFORE.timestamp_us} us after {BEFORE.timestamp_us} us"),
        ),
        (
            {"received_ns": BEFORE.received_ns - 2},
            MS,
            (HoldReason.CLOCK_BACKWARDS, "received 2 ns before the last frame"),
        ),
        ({"received_ns": BEFORE.received_ns}, MS, (HoldReason.CLOCK_BACKWARDS, "received 0 ns before the last frame")),
        ({"missed_frames": -1}, MS, (HoldReason.VALUE_INVALID, "-1 missed frames")),
        ({"missed_frames": 1}, MS, (HoldReason.FRAME_MISSING, "1 frames lost by the camera")),
        ({"frame_index": 5}, MS, (HoldReason.FRAME_MISSING, "frame 5 after frame 3")),
    ],
)
def test_order_is_refused_by_what_is_out_of_it(changes, age_ns, refusal):
    assert refused(replace(NEXT, **changes), age_ns=age_ns) == refusal


@pytest.mark.parametrize("slower", ["host", "device", "both"])
def test_a_gap_that_equals_its_bound_is_none(slower):
    limits = replace(EASY, max_gap_ms=PERIOD_MS)
    assert refused(limits=limits) is None
    late = replace(
        NEXT,
        received_ns=NEXT.received_ns + (1_000 if slower != "device" else 0),
        timestamp_us=NEXT.timestamp_us + (1 if slower != "host" else 0),
    )
    assert refused(late, limits) == (HoldReason.FRAME_MISSING, "33 ms after the last frame")


def test_a_clock_that_gets_ahead_by_its_bound_has_not_jumped():
    limits = replace(EASY, max_clock_jump_ms=50.0)
    jump_us = 50_000
    assert refused(replace(NEXT, timestamp_us=NEXT.timestamp_us + jump_us), limits) is None
    ahead = replace(NEXT, timestamp_us=NEXT.timestamp_us + jump_us + 1)
    assert refused(ahead, limits) == (
        HoldReason.CLOCK_JUMPED,
        "the camera's clock advanced 50 ms more than the host's",
    )
    assert refused(ahead, replace(limits, is_played=True)) is None


@pytest.mark.parametrize(
    ("limits", "bound_ms", "at_bound", "beyond"),
    [
        (EASY, 200.0, None, (HoldReason.FRAME_LATE, "decided 200 ms after it was received")),
        (
            EASY,
            300.0,
            (HoldReason.FRAME_LATE, "decided 300 ms after it was received"),
            (HoldReason.FRAME_STALE, "the newest frame is 300 ms old"),
        ),
        (
            replace(EASY, max_latency_ms=100.0, warn_latency_ms=50.0, camera_latency_ms=60.0),
            40.0,
            None,
            (HoldReason.LATENCY_HIGH, "100 ms since the camera took the frame, 100 allowed"),
        ),
    ],
    ids=["late", "stale", "latency"],
)
def test_the_age_of_a_frame_at_its_decision(limits, bound_ms, at_bound, beyond):
    assert refused(limits=limits, age_ns=round(bound_ms * MS)) == at_bound
    assert refused(limits=limits, age_ns=round(bound_ms * MS) + 1) == beyond


def test_a_lag_that_equals_its_bound_is_not_late():
    limits = replace(EASY, max_lag_ms=40.0)
    drift_ns = BEFORE.least_lag_ns - (BEFORE.received_ns - BEFORE.timestamp_us * 1_000)
    assert drift_ns == 0
    late = replace(NEXT, received_ns=NEXT.received_ns + 41 * MS, queue_empty_ns=NEXT.received_ns + 41 * MS)
    assert refused(late, limits) == (HoldReason.FRAME_LATE, "received 41 ms later than the fastest frame")
    assert refused(late, replace(limits, is_played=True)) is None
    assert refused(late, replace(limits, max_lag_ms=42.0)) is None


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"whole_mm": math.nan}, "whole (gated), whole"),
        ({"whole_mm": math.inf}, "whole (gated), whole"),
        ({"thorax_mm": math.nan}, "thorax"),
        ({"abdomen_mm": math.nan}, "abdomen"),
        ({"residual_mm": math.nan}, "residual"),
        ({"valid_share": math.nan}, "valid share, fit"),
        ({"inlier_share": math.nan}, "inlier share, fit"),
        ({"beta": (1.0, math.nan, 0.0)}, "coefficients"),
        ({"coefficients": (1.0, math.inf, 0.0, 0.0)}, "coefficients"),
        ({"residual_mm": -0.001}, "fit"),
        ({"valid_share": -0.001}, "fit"),
        ({"valid_share": 1.001}, "fit"),
        ({"inlier_share": -0.001}, "fit"),
        ({"inlier_share": 1.001}, "fit"),
    ],
)
def test_each_value_that_is_no_number_is_named(changes, named):
    frame = replace(
        NEXT,
        motion=motion_of(
            changes.get("whole_mm", LEVEL_MM),
            **{name: value for name, value in changes.items() if name != "whole_mm"},
        ),
    )
    assert refused(frame) == (HoldReason.VALUE_INVALID, f"not a number: {named}")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"valid_share": 1.0, "inlier_share": 1.0, "residual_mm": 0.0}, None),
        ({"valid_share": 0.0}, HoldReason.COVERAGE_LOW),
        ({"inlier_share": 0.0}, HoldReason.RESIDUAL_HIGH),
    ],
)
def test_shares_from_none_to_all_are_numbers(changes, reason):
    found = refused(replace(NEXT, motion=motion_of(**changes)))
    assert (None if found is None else found[0]) is reason


@pytest.mark.parametrize(("step_mm", "refusal"), [(1.5, None), (1.75, (HoldReason.JUMP, "1.8 mm in 1 frames"))])
def test_a_step_up_to_its_bound_is_none(step_mm, refusal):
    assert refused(replace(NEXT, motion=motion_of(LEVEL_MM - step_mm))) == refusal


def test_what_is_remembered_of_a_frame_is_its_index_its_times_and_its_signals():
    found = followed_frame(BEFORE, NEXT)
    assert (found.index, found.timestamp_us, found.received_ns) == (4, NEXT.timestamp_us, NEXT.received_ns)
    assert (found.signals_mm, found.signal_age_frames) == ((LEVEL_MM,), 0)
    hidden = followed_frame(found, replace(measured(5), motion=None, missed_frames=2))
    assert (hidden.signals_mm, hidden.signal_age_frames) == ((LEVEL_MM,), 3)
    unknown = followed_frame(found, replace(measured(5), motion=motion_of(math.nan)))
    assert (unknown.signals_mm, unknown.signal_age_frames) == ((LEVEL_MM,), 1)
    first = followed_frame(None, replace(measured(5), motion=None))
    assert (first.signals_mm, first.signal_age_frames) == (None, 0)
    assert found.timestamp_us - BEFORE.timestamp_us == PERIOD_US
