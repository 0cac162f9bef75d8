"""The beam goes off after two breaths, or the site's limit, without the signal's having left the window."""

from dataclasses import replace

import pytest

from engine.core.breath import Breath, SignalChoice
from engine.core.commands import Arm, Disarm
from engine.core.frames import LostReason, MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.gating.beam_on_limit import Stay, allowed_on_s
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, JoinedWindow, PhaseWindow, amplitude_window
from tests.support.gating.streams import LIMITS, PERIOD_NS, Stream, motion_of, stream_in, unmeasured

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
    ],
)
def test_what_is_allowed_in_each_kind_of_window(window, breaths, expected):
    assert allowed_on_s(window, breaths, EASY) == expected


@pytest.mark.parametrize(("short_ns", "is_over"), [(0, True), (1, False)])
def test_the_time_of_a_stay_is_over_at_its_limit_itself(short_ns, is_over):
    stream = stream_in(GateState.DWELL, limits=EASY)
    allowed_ns = 5_000_000_000
    stream.gate = replace(stream.gate, stay=Stay(on_ns=allowed_ns - short_ns, allowed_ns=allowed_ns))
    gate = stream.feed()
    assert (gate.reason is HoldReason.BEAM_ON_LIMIT) is is_over
    if is_over:
        assert gate.detail == (
            "5 s of beam since the signal was outside of the window, 5 allowed: it has to leave the window first"
        )
