"""A gated signal that the camera does not see is not measurable: whatever its value, it never permits the beam."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from engine.core.breath import Breath, SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.frames import SeenShares
from engine.core.gate_state import GateState, HoldReason
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, Join, JoinedWindow, PhaseWindow, Unit
from tests.support.gating.streams import LIMITS, SEEN, Stream, motion_of, stream_in

WHOLE, ABDOMEN, VOLUME = SignalChoice(), SignalChoice(signal="abdomen"), SignalChoice(signal="volume")
CELL = SignalChoice(signal="region", row=12, column=4)
POINT = SignalChoice(signal="point", row=320, column=90, index=1)
BELLY = SignalChoice(signal="named", name="belly", index=2)
CHOICES = (WHOLE, SignalChoice(signal="thorax"), ABDOMEN, VOLUME, CELL, POINT, BELLY)
NEEDED = {
    choice: LIMITS.min_signal_share if choice in (CELL, POINT, BELLY) else LIMITS.min_wide_share for choice in CHOICES
}


def with_share(choice, share):
    """Everything is seen but this signal, of which it is ``share``."""
    if choice in (WHOLE, VOLUME):
        return replace(SEEN, whole=share)
    if choice == CELL:
        cells = np.ones((14, 8))
        cells[12, 4] = share
        return replace(SEEN, cells=cells)
    if choice in (POINT, BELLY):
        one = np.ones(4)
        one[choice.index] = share
        return replace(SEEN, points=one) if choice == POINT else replace(SEEN, named=one)
    return replace(SEEN, **{str(choice.signal): share})


def window_on(choice, lower=-10.0, upper=10.0):
    return AmplitudeWindow(choice=choice, lower=lower, upper=upper, unit=Unit.L if choice.is_volume else Unit.MM)


def motion(**changes):
    return replace(motion_of(**changes), points_mm=np.zeros(4), named_mm=np.zeros(4))


class Gated(Stream):
    """A stream whose frames have what a test says about seeing them."""

    def see(self, frames, **changes):
        states = []
        for _ in range(frames):
            good = self.upcoming()
            breath = tuple(Breath(signal=choice, phase_percent=50.0, phase_confidence=0.9) for choice in CHOICES)
            states.append(self.feed(replace(good, motion=motion(**changes), breaths=breath)).state)
        return states


def armed(window, **limits):
    stream = Gated(replace(LIMITS, window=window, **limits))
    stream.see(3)
    stream.gate = stream_in(GateState.HOLD).gate
    stream.gate = replace(stream.gate, last=None, conditions=())
    return stream


@pytest.mark.parametrize("choice", CHOICES, ids=lambda choice: choice.label)
def test_each_kind_of_signal_is_held_by_its_own_share_and_named(choice):
    stream = armed(window_on(choice))
    assert stream.see(8)[-1] is GateState.BEAM_ON
    needed = NEEDED[choice]
    assert stream.see(1, seen=with_share(choice, needed))[-1] is GateState.BEAM_ON
    assert stream.see(1, seen=with_share(choice, needed - 0.01))[-1] is GateState.HOLD
    assert stream.gate.reason is HoldReason.COVERAGE_LOW
    assert stream.gate.detail == f"{choice.label}: {needed - 0.01:.2f} of its area seen, {needed:.2f} needed"
    assert GateState.BEAM_ON not in stream.see(3), "a new beam on needs a full dwell"
    assert stream.see(2)[-1] is GateState.BEAM_ON


@pytest.mark.parametrize("choice", CHOICES, ids=lambda choice: choice.label)
def test_the_other_signals_may_gate_meanwhile(choice):
    blind = with_share(choice, 0.0)
    for other in CHOICES:
        is_same = other == choice or {other, choice} == {WHOLE, VOLUME}
        assert (armed(window_on(other)).see(8, seen=blind)[-1] is GateState.BEAM_ON) is not is_same


@pytest.mark.parametrize("share", [math.nan, math.inf, -math.inf, -0.1, 1.01])
@pytest.mark.parametrize("choice", CHOICES, ids=lambda choice: choice.label)
def test_a_share_that_is_no_share_holds(choice, share):
    for name in ("seen", "reference_seen"):
        stream = armed(window_on(choice))
        assert GateState.BEAM_ON not in stream.see(8, **{name: with_share(choice, share)})
        assert stream.gate.reason is HoldReason.COVERAGE_LOW


@pytest.mark.parametrize("choice", CHOICES, ids=lambda choice: choice.label)
def test_an_absent_share_holds(choice):
    stream = armed(window_on(choice))
    assert GateState.BEAM_ON not in stream.see(8, seen=SeenShares())
    assert GateState.BEAM_ON not in stream.see(8, reference_seen=SeenShares())
    assert stream.gate.reason is HoldReason.COVERAGE_LOW
    assert stream.see(8)[-1] is GateState.BEAM_ON


def test_a_signal_that_was_not_seen_when_the_reference_was_set_has_no_reference():
    stream = armed(window_on(CELL))
    assert GateState.BEAM_ON not in stream.see(8, reference_seen=with_share(CELL, 0.3))
    assert stream.gate.detail == "region 12,4: 0.30 of its area seen when the reference was set, 0.70 needed"


@pytest.mark.parametrize("join", list(Join))
@pytest.mark.parametrize("unseen", [ABDOMEN, CELL, POINT])
def test_every_condition_of_a_joined_window_has_its_own_signal(join, unseen):
    stream = armed(JoinedWindow(conditions=(window_on(WHOLE), window_on(unseen)), join=join))
    assert stream.see(8)[-1] is GateState.BEAM_ON
    assert stream.see(1, seen=with_share(unseen, 0.2))[-1] is GateState.HOLD
    assert unseen.label in stream.gate.detail


@pytest.mark.parametrize(
    "window",
    [
        PhaseWindow(choice=CELL, from_percent=30.0, to_percent=70.0),
        BreathHoldWindow(level=window_on(CELL), settle_ms=100.0),
    ],
    ids=["phase", "breath hold"],
)
def test_phase_and_breath_hold_need_to_see_their_signal(window):
    stream = armed(window)
    assert stream.see(12)[-1] is GateState.BEAM_ON
    assert stream.see(1, seen=with_share(CELL, 0.2))[-1] is GateState.HOLD
    assert stream.gate.reason is HoldReason.COVERAGE_LOW


def test_a_fault_of_a_value_comes_before_what_was_not_seen():
    stream = armed(window_on(CELL))
    stream.see(1, regions_mm=math.nan, seen=SeenShares())
    assert stream.gate.reason is HoldReason.VALUE_INVALID


@pytest.mark.parametrize(("name", "low"), [("min_signal_share", 0.5), ("min_wide_share", 0.7)])
def test_the_limits_cannot_be_switched_off(name, low):
    assert getattr(replace(LIMITS, **{name: low}), name) == low
    for wrong in (low - 0.01, 1.01, math.nan, True):
        with pytest.raises(InvalidValueError, match=name):
            replace(LIMITS, **{name: wrong})


shares = st.one_of(st.floats(0.0, 1.0), st.just(math.nan), st.just(1.0), st.just(0.0))


@settings(max_examples=60, deadline=None)
@given(
    gated=st.lists(st.sampled_from(CHOICES), min_size=1, max_size=3, unique=True),
    join=st.sampled_from(list(Join)),
    frames=st.lists(
        st.tuples(st.sampled_from(CHOICES), shares, st.booleans(), st.integers(1, 6)), min_size=1, max_size=6
    ),
)
def test_a_frame_in_which_a_gated_signal_was_not_seen_never_permits(gated, join, frames):
    windows = tuple(window_on(choice) for choice in gated)
    stream = armed(windows[0] if len(windows) == 1 else JoinedWindow(conditions=windows, join=join))
    for choice, share, is_reference, count in frames:
        seen = with_share(choice, share)
        states = stream.see(count, **{"reference_seen" if is_reference else "seen": seen})
        is_gated = choice in gated or (choice in (WHOLE, VOLUME) and bool({WHOLE, VOLUME} & set(gated)))
        if is_gated and not share >= NEEDED[choice]:
            assert GateState.BEAM_ON not in states
            assert stream.gate.reason is HoldReason.COVERAGE_LOW
    assert stream.see(6)[-1] is GateState.BEAM_ON
