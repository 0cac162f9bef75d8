"""Gating by phase: only a phase that is known, and known well, is inside."""

import math
from dataclasses import replace

import pytest

from engine.core.breath import WHOLE, Breath, SignalChoice
from engine.core.commands import Arm
from engine.core.errors import InvalidValueError
from engine.core.gate_state import GateState, HoldReason
from engine.gating.windows import PhaseWindow
from tests.support.gating.streams import LIMITS, Stream

WINDOW = PhaseWindow(from_percent=30.0, to_percent=70.0, min_confidence=0.6)


def breath(phase_percent: float | None, confidence: float = 0.9, signal: SignalChoice = WHOLE) -> Breath:
    return Breath(signal=signal, phase_percent=phase_percent, phase_confidence=confidence, note="as the test wants it")


class PhaseStream(Stream):
    """Good frames, each with one breath."""

    breath: Breath = breath(50.0)

    def upcoming(self):
        return replace(super().upcoming(), breaths=(self.breath,))


def armed(window: PhaseWindow = WINDOW) -> PhaseStream:
    stream = PhaseStream(replace(LIMITS, window=window))
    stream.good(2)
    stream.step(Arm(operator="ann"))
    return stream


def test_the_beam_is_on_after_a_dwell_inside():
    assert armed().good(4) == [GateState.DWELL] * 3 + [GateState.BEAM_ON]


@pytest.mark.parametrize(("phase_percent", "is_inside"), [(29.9, False), (30.0, True), (70.0, True), (70.1, False)])
def test_the_edges_belong_to_the_window(phase_percent, is_inside):
    stream = armed()
    stream.breath = breath(phase_percent)
    assert (stream.feed().state is GateState.DWELL) is is_inside


@pytest.mark.parametrize(
    ("phase_percent", "is_inside"),
    [(89.0, False), (90.0, True), (99.9, True), (0.0, True), (10.0, True), (11.0, False)],
)
def test_a_window_over_the_end_of_inhale_goes_over_nought(phase_percent, is_inside):
    stream = armed(PhaseWindow(from_percent=90.0, to_percent=10.0))
    stream.breath = breath(phase_percent)
    assert (stream.feed().state is GateState.DWELL) is is_inside


@pytest.mark.parametrize(
    "unknown",
    [breath(None), breath(50.0, 0.59), breath(50.0, math.nan), breath(50.0, signal=SignalChoice(signal="thorax"))],
)
def test_a_phase_that_is_not_known_well_holds_at_once(unknown):
    stream = armed()
    stream.good(6)
    assert stream.gate.state is GateState.BEAM_ON
    stream.breath = unknown
    gate = stream.feed()
    assert (gate.state, gate.reason) == (GateState.HOLD, HoldReason.PHASE_UNKNOWN)


def test_a_hold_states_why_the_phase_is_unknown_or_where_it_is():
    stream = armed()
    for seen, reason, detail in (
        (breath(None), HoldReason.PHASE_UNKNOWN, "as the test wants it"),
        (
            breath(50.0, signal=SignalChoice(signal="thorax")),
            HoldReason.PHASE_UNKNOWN,
            "the phase of this signal is not computed",
        ),
        (breath(50.0, 0.59), HoldReason.PHASE_UNKNOWN, "confidence 0.59, 0.60 needed"),
        (breath(20.0), HoldReason.OUTSIDE_WINDOW, "20 % is not inside 30 to 70 %"),
    ):
        stream.breath = seen
        gate = stream.feed()
        assert (gate.reason, gate.detail) == (reason, detail)


def test_the_least_confidence_itself_is_enough():
    stream = armed()
    stream.breath = breath(50.0, WINDOW.min_confidence)
    assert stream.feed().state is GateState.DWELL


def test_a_phase_that_is_no_number_is_outside():
    stream = armed()
    stream.breath = breath(math.nan)
    assert stream.feed().state is GateState.HOLD


def test_no_breath_at_all_holds():
    stream = armed()
    gate = stream.feed(replace(stream.upcoming(), breaths=()))
    assert (gate.state, gate.reason) == (GateState.HOLD, HoldReason.PHASE_UNKNOWN)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"from_percent": -0.1}, "from_percent"),
        ({"from_percent": 100.1}, "from_percent"),
        ({"to_percent": 100.1}, "to_percent"),
        ({"to_percent": -0.1}, "to_percent"),
        ({"to_percent": math.nan}, "to_percent"),
        ({"to_percent": 30.0}, "to_percent"),
        ({"from_percent": 0.0, "to_percent": 100.0}, "to_percent"),
        ({"min_confidence": 0.0}, "min_confidence"),
        ({"min_confidence": 1.1}, "min_confidence"),
    ],
)
def test_a_phase_window_that_is_none_is_refused_by_field(changes, field):
    with pytest.raises(InvalidValueError) as refusal:
        replace(WINDOW, **changes)
    assert refusal.value.field == field
    assert str(changes[field]) in str(refusal.value)


def test_a_window_may_end_with_the_cycle_or_begin_with_it():
    assert PhaseWindow(from_percent=50.0, to_percent=0.0).contains(75.0)
    assert PhaseWindow(from_percent=100.0, to_percent=50.0).contains(25.0)
