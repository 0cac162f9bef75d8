"""The beam is on at breathing rates that are gated, where the rate is known; a held breath has none."""

from dataclasses import replace

import pytest

from engine.core.breath import WHOLE, Breath, GateSignal, SignalChoice
from engine.core.gate_state import GateState, HoldReason
from engine.gating.frame_checks import SURE_RATE
from tests.support.gating.streams import LIMITS, stream_in


def decided(rate, *, confidence=1.0, signal=WHOLE, **limits):
    """The gate after a frame of a beam that is on, of a patient who breathes at this rate."""
    stream = stream_in(GateState.BEAM_ON, limits=replace(LIMITS, **limits))
    breath = Breath(signal=signal, rate_per_min=rate, rate_confidence=confidence)
    stream.feed(replace(stream.upcoming(), breaths=(breath,)))
    return stream.gate


@pytest.mark.parametrize("rate", [1.0, 4.0, 15.0, 30.0])
def test_a_rate_within_the_bounds_holds_nothing(rate):
    assert decided(rate).state is GateState.BEAM_ON


@pytest.mark.parametrize("rate", [0.9, 30.1, 45.0])
def test_a_slower_and_a_faster_one_hold_and_are_named(rate):
    gate = decided(rate)
    assert (gate.state, gate.reason) == (GateState.HOLD, HoldReason.BREATHING_IRREGULAR)
    assert gate.detail == f"whole: {rate:.0f} breaths a minute, 1 to 30 are gated"


def test_the_bounds_are_the_site_s():
    assert decided(45.0, max_breaths_per_min=50.0).state is GateState.BEAM_ON
    assert decided(8.0, min_breaths_per_min=10.0).state is GateState.HOLD


def test_a_rate_that_is_not_known_or_of_another_signal_holds_nothing():
    assert decided(None).state is GateState.BEAM_ON
    assert decided(45.0, confidence=SURE_RATE - 0.01).state is GateState.BEAM_ON
    assert decided(45.0, confidence=SURE_RATE).state is GateState.HOLD
    assert decided(45.0, signal=SignalChoice(signal=GateSignal.THORAX)).state is GateState.BEAM_ON
