"""The beam goes off after two breaths, or the site's limit, without the signal's having left the window."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from engine.core.breath import Breath, SignalChoice
from engine.core.commands import Arm, Disarm
from engine.core.frames import LostReason, MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.gating.beam_on_limit import Stay, allowed_on_s
from engine.gating.gate import Interruption, Silence
from engine.gating.windows import (
    AmplitudeWindow,
    BreathDepth,
    BreathHoldWindow,
    JoinedWindow,
    PhaseWindow,
    amplitude_window,
    rescaled,
)
from tests.support.gating.streams import (
    A_BREATH_FRAMES,
    LEVEL_MM,
    LIMITS,
    PERIOD_NS,
    Stream,
    motion_of,
    stream_in,
    unmeasured,
)

EASY = replace(LIMITS, max_jump_mm=20.0, max_beam_on_s=5.0)
WINDOW = LIMITS.window
SLOW = Breath(rate_per_min=10.0)
FRAMES_A_S = 1_000_000_000 / PERIOD_NS


def fed(stream: Stream, seconds: float, breath: Breath | None = None) -> float:
    """Feed good frames inside for so long; return the time of it with the beam on [s]."""
    states = []
    for _ in range(round(seconds * FRAMES_A_S)):
        frame = stream.upcoming()
        states.append(stream.feed(replace(frame, breaths=() if breath is None else (breath,))).state)
    return states.count(GateState.BEAM_ON) / FRAMES_A_S


def leave(stream: Stream) -> None:
    for _ in range(A_BREATH_FRAMES):
        stream.feed(replace(stream.upcoming(), motion=motion_of(9.0)))


def test_the_beam_is_on_for_no_longer_than_the_limit_until_the_signal_has_left_the_window():
    stream = stream_in(GateState.BEAM_ON, limits=EASY)
    assert fed(stream, 12.0) == pytest.approx(5.0, abs=0.1)
    assert (stream.gate.state, stream.gate.reason) == (GateState.HOLD, HoldReason.BEAM_ON_LIMIT)
    assert "5 s of beam" in stream.gate.detail
    leave(stream)
    assert stream.gate.reason is HoldReason.OUTSIDE_WINDOW
    assert fed(stream, 2.0) == pytest.approx(1.9, abs=0.1)


@pytest.mark.parametrize("way", ["lost frames", "arming again"])
def test_nothing_but_a_frame_outside_begins_the_time_anew(way):
    stream, on_s = stream_in(GateState.BEAM_ON, limits=EASY), 0.0
    for _ in range(10):
        on_s += fed(stream, 1.0)
        if way == "lost frames":
            for _ in range(3):
                stream.feed(unmeasured(stream.upcoming(), MeasurementState.LOST, LostReason.MARKER_LOST))
        else:
            stream.step(Disarm(operator="ann"))
            fed(stream, 0.2)
            stream.step(Arm(operator="ann"))
    assert on_s == pytest.approx(5.0, abs=0.2)
    assert stream.gate.state is not GateState.BEAM_ON


def test_a_long_silence_is_no_beam_on():
    stream = stream_in(GateState.BEAM_ON, limits=EASY)
    stream.next_slot += 1000
    assert fed(stream, 4.0) > 3.5


@pytest.mark.parametrize(("rate", "limit_s", "allowed"), [(30.0, 30.0, 4.0), (10.0, 30.0, 12.0), (10.0, 5.0, 5.0)])
def test_two_breaths_bound_it_where_the_rate_is_known(rate, limit_s, allowed):
    stream = stream_in(GateState.BEAM_ON, limits=replace(EASY, max_beam_on_s=limit_s))
    assert fed(stream, 40.0, Breath(rate_per_min=rate)) == pytest.approx(allowed, abs=0.2)


def test_a_rate_that_is_lost_in_apnoea_still_bounds_it():
    stream = stream_in(GateState.BEAM_ON, limits=replace(EASY, max_beam_on_s=30.0))
    before = fed(stream, 1.0, SLOW)
    assert before + fed(stream, 40.0) == pytest.approx(12.0, abs=0.2)


def test_a_breath_that_leaves_the_window_is_never_held():
    stream, on_s = stream_in(GateState.BEAM_ON, limits=EASY), 0.0
    for _ in range(30):
        on_s += fed(stream, 2.0, Breath(rate_per_min=20.0))
        leave(stream)
        assert stream.gate.reason is HoldReason.OUTSIDE_WINDOW
    assert on_s > 30 * 1.8


THORAX = SignalChoice(signal="thorax")
HOLD = BreathHoldWindow(level=WINDOW)


@pytest.mark.parametrize(
    ("window", "breaths", "expected"),
    [
        (WINDOW, (), 5.0),
        (WINDOW, (Breath(rate_per_min=40.0),), 3.0),
        (WINDOW, (Breath(signal=SignalChoice(signal="thorax"), rate_per_min=40.0),), 5.0),
        (PhaseWindow(from_percent=40.0, to_percent=60.0), (Breath(rate_per_min=40.0),), 3.0),
        (HOLD, (Breath(rate_per_min=40.0),), None),
        (JoinedWindow(conditions=(HOLD, WINDOW), join="and"), (Breath(rate_per_min=40.0),), None),
        (JoinedWindow(conditions=(HOLD, WINDOW), join="or"), (Breath(rate_per_min=40.0),), 5.0),
        (
            JoinedWindow(conditions=(WINDOW, amplitude_window(lower_mm=0.0, upper_mm=5.0)), join="or"),
            (Breath(rate_per_min=40.0), Breath(signal=SignalChoice(signal="thorax"), rate_per_min=10.0)),
            3.0,
        ),
        (
            JoinedWindow(conditions=(WINDOW, AmplitudeWindow(choice=THORAX, lower=-5.0, upper=5.0)), join="and"),
            (Breath(rate_per_min=60.0), Breath(signal=THORAX, rate_per_min=40.0)),
            3.0,
        ),
        (
            JoinedWindow(conditions=(WINDOW, AmplitudeWindow(choice=THORAX, lower=-5.0, upper=5.0)), join="and"),
            (Breath(rate_per_min=40.0), Breath(signal=THORAX, rate_per_min=60.0)),
            3.0,
        ),
    ],
)
def test_what_is_allowed_in_each_kind_of_window(window, breaths, expected):
    assert allowed_on_s(breaths, replace(EASY, window=window)) == expected


@pytest.mark.parametrize(("short_ns", "is_over"), [(0, True), (1, False)])
def test_the_time_of_a_stay_is_over_at_its_limit_itself(short_ns, is_over):
    stream = stream_in(GateState.DWELL, limits=EASY)
    allowed_ns = 5_000_000_000
    stream.gate = replace(stream.gate, stay=Stay(on_ns=allowed_ns - short_ns, allowed_ns=allowed_ns))
    gate = stream.feed()
    assert (gate.reason is HoldReason.BEAM_ON_LIMIT) is is_over
    if is_over:
        assert gate.detail == (
            "5 s of beam since the patient breathed out of the window, 5 allowed: "
            "the signal has to leave the window first"
        )


WIDE = amplitude_window(lower_mm=-1.0, upper_mm=3.0, hysteresis_mm=1.5)
HELD = BreathHoldWindow(level=WIDE, settle_ms=100.0, still=0.5, max_drift=2.0, timeout_s=2.0)
SLIM = amplitude_window(lower_mm=0.0, upper_mm=2.0)
BOUNDED = {
    "amplitude": WIDE,
    "amplitude or amplitude": JoinedWindow(conditions=(WIDE, SLIM), join="or"),
    "amplitude and amplitude": JoinedWindow(conditions=(WIDE, WINDOW), join="and"),
    "breath hold": HELD,
    "breath hold or amplitude": JoinedWindow(conditions=(HELD, SLIM), join="or"),
    "breath hold and amplitude": JoinedWindow(conditions=(HELD, WINDOW), join="and"),
}
"""Windows whose beam-on is 2 s at most while no value lies beyond an edge of the union of their conditions."""


def interrupt(stream: Stream, how: str) -> None:
    """Let something happen after which every condition has to be entered again."""
    match how:
        case "lost":
            stream.feed(unmeasured(stream.upcoming(), MeasurementState.LOST, LostReason.MARKER_LOST))
        case "held":
            stream.step(Interruption(HoldReason.OPERATOR_HOLD, "held by bob"))
        case "silent":
            stream.step(Silence(since_ns=stream.now_ns))
        case "armed again":
            stream.step(Disarm(operator="ann"))
            stream.step(Arm(operator="ann"))


PIECES = st.tuples(
    st.sampled_from(["lost", "held", "silent", "armed again", "nothing"]),
    st.sampled_from(["the margin below", "the middle", "the margin above"]),
    st.integers(1, 20),
)
LEVELS_MM = {"the margin below": -0.95, "the middle": 1.0, "the margin above": 2.95}


@pytest.mark.parametrize("kind", BOUNDED)
@given(pieces=st.lists(PIECES, min_size=3, max_size=8))
@settings(max_examples=25)
def test_without_a_value_beyond_an_edge_the_sum_of_beam_on_never_exceeds_the_limit(kind, pieces):
    """Begun with the beam on, so that every history has beam; the window's edges are -1 and 3 mm."""
    stream = Stream(replace(EASY, window=BOUNDED[kind], max_beam_on_s=2.0), 1.0)
    stream.good(1)
    stream.step(Arm(operator="ann"))
    on = stream.good(20).count(GateState.BEAM_ON)
    assert on > 10
    for how, where, frames in pieces:
        interrupt(stream, how)
        for level_mm, count in ((LEVELS_MM[where], frames), (1.0, 30)):
            stream.level_mm = level_mm
            on += stream.good(count).count(GateState.BEAM_ON)
    assert on / FRAMES_A_S <= 2.0 + len(pieces) / FRAMES_A_S


@pytest.mark.parametrize(
    ("level_mm", "frames", "stays"),
    [
        (2.81, 60, True),
        (3.0, 60, True),
        (3.19, 60, True),
        (3.21, A_BREATH_FRAMES - 1, True),
        (3.21, A_BREATH_FRAMES, False),
        (-1.19, 60, True),
        (-1.6, A_BREATH_FRAMES - 1, True),
        (-1.6, A_BREATH_FRAMES, False),
        (9.0, 1, True),
    ],
)
def test_a_stay_ends_only_beyond_an_edge_by_the_hysteresis_for_as_long_as_a_breath_takes(level_mm, frames, stays):
    """Hysteresis is 0.2 mm: a signal at 3.19 mm, or one that is further out for a moment, is no breath."""
    stream = stream_in(GateState.BEAM_ON, limits=EASY)
    fed(stream, 12.0)
    assert stream.gate.reason is HoldReason.BEAM_ON_LIMIT
    stream.level_mm = level_mm
    assert set(stream.good(frames)) == {GateState.HOLD}
    stream.level_mm = LEVEL_MM
    assert (GateState.BEAM_ON not in stream.good(60)) is stays


@pytest.mark.parametrize("is_rescaled", [False, True])
def test_a_noisy_signal_has_to_be_further_out(is_rescaled):
    """Noise of 0.3 mm: 1.0 mm beyond an edge is hardly more than three times that, 2.0 mm is; also right after a
    reference."""
    for level_mm, stays in ((4.0, True), (5.0, False)):
        stream, noise = stream_in(GateState.BEAM_ON, limits=EASY), np.random.default_rng(4)
        for seconds, middle_mm in ((12.0, LEVEL_MM), (0.04, LEVEL_MM), (2.0, level_mm), (2.0, LEVEL_MM)):
            states = []
            if seconds < 1.0 and is_rescaled:
                stream.gate = replace(stream.gate, conditions=rescaled(stream.gate.conditions))
            for _ in range(round(seconds * FRAMES_A_S)):
                stream.level_mm = middle_mm + float(np.clip(noise.normal(0.0, 0.3), -0.6, 0.6))
                states.append(stream.feed().state)
        assert (GateState.BEAM_ON not in states) is stays


DEEP = replace(EASY, breath_depths=(BreathDepth(SignalChoice(), 3.0),))


@pytest.mark.parametrize(("level_mm", "stays"), [(1.01, True), (0.99, False)])
def test_a_third_of_the_learned_breath_away_from_where_the_beam_was_on_is_a_breath(level_mm, stays):
    stream = stream_in(GateState.BEAM_ON, limits=DEEP)
    fed(stream, 12.0)
    stream.level_mm = level_mm  # still inside: without beam, for the limit is reached
    stream.good(A_BREATH_FRAMES + 1)
    stream.level_mm = LEVEL_MM
    assert (GateState.BEAM_ON not in stream.good(60)) is stays


def test_in_a_window_that_is_hardly_left_the_beam_on_since_the_last_movement_stays_counted():
    """The signal moves by a third of the breath with the beam on, and is out for a moment: a breath, from then on."""
    stream, out = stream_in(GateState.BEAM_ON, limits=DEEP, level_mm=1.0), 5
    fed(stream, 2.0)
    stream.level_mm = 2.7
    fed(stream, 1.0)
    for level_mm, frames in ((3.05, out), (2.7, 300)):
        stream.level_mm = level_mm
        states = stream.good(frames)
    assert states.count(GateState.BEAM_ON) / FRAMES_A_S == pytest.approx(4.0, abs=0.2)
    stream.level_mm = 3.05
    stream.good(out)
    stream.level_mm = 2.7
    assert GateState.BEAM_ON not in stream.good(60)


def test_an_unknown_phase_ends_no_stay():
    window = PhaseWindow(from_percent=40.0, to_percent=60.0)
    unknown, inside, beyond = (Breath(phase_percent=percent, phase_confidence=1.0) for percent in (None, 50.0, 70.0))
    stream = Stream(replace(DEEP, window=window))
    stream.step(Arm(operator="ann"))
    assert fed(stream, 12.0, inside) == pytest.approx(5.0, abs=0.2)
    fed(stream, 0.5, unknown)
    assert fed(stream, 1.0, inside) == 0.0
    fed(stream, 0.5, beyond)
    assert fed(stream, 1.0, inside) == 0.0  # the signal has not moved
    stream.level_mm = 0.5
    fed(stream, 0.5, beyond)
    stream.level_mm = LEVEL_MM
    assert fed(stream, 1.0, inside) > 0.7
