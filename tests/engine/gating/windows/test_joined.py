"""Conditions joined: AND needs all, OR any; each remembers for itself."""

from dataclasses import replace

import pytest

from engine.core.breath import SignalChoice
from engine.core.commands import Arm
from engine.core.errors import InvalidValueError
from engine.core.gate_state import GateState, HoldReason
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, GateWindow, JoinedWindow, PhaseWindow
from engine.gating.windows.phase import MAX_CONDITIONS
from tests.support.gating.streams import LIMITS, Stream, measured, motion_of

CHEST = AmplitudeWindow(choice=SignalChoice(signal="thorax"), lower=-1.0, upper=2.0, hysteresis=0.5)
BELLY = AmplitudeWindow(choice=SignalChoice(signal="abdomen"), lower=-1.0, upper=3.0)


class Two(Stream):
    """Good frames with a chest and a belly of their own."""

    chest_mm = belly_mm = 1.0

    def upcoming(self):
        frame = super().upcoming()
        return replace(frame, motion=motion_of(thorax_mm=self.chest_mm, abdomen_mm=self.belly_mm))


def armed(window: GateWindow) -> Two:
    stream = Two(replace(LIMITS, window=window, max_jump_mm=20.0))
    stream.good(2)
    stream.step(Arm(operator="ann"))
    return stream


@pytest.mark.parametrize(
    ("join", "chest_mm", "belly_mm", "is_inside"),
    [
        ("and", 1.0, 1.0, True),
        ("and", 5.0, 1.0, False),
        ("and", 1.0, 5.0, False),
        ("and", 5.0, 5.0, False),
        ("or", 1.0, 1.0, True),
        ("or", 5.0, 1.0, True),
        ("or", 1.0, 5.0, True),
        ("or", 5.0, 5.0, False),
    ],
)
def test_and_needs_all_and_or_any(join, chest_mm, belly_mm, is_inside):
    stream = armed(JoinedWindow(conditions=(CHEST, BELLY), join=join))
    stream.good(6)
    assert stream.gate.state is GateState.BEAM_ON
    stream.chest_mm, stream.belly_mm = chest_mm, belly_mm
    gate = stream.feed()
    assert (gate.state is GateState.BEAM_ON) is is_inside
    assert (gate.reason is HoldReason.OUTSIDE_WINDOW) is not is_inside


def test_the_reason_names_the_first_condition_that_is_not_met():
    stream = armed(JoinedWindow(conditions=(BELLY, PhaseWindow(from_percent=30.0, to_percent=70.0))))
    assert stream.feed().reason is HoldReason.PHASE_UNKNOWN
    stream.belly_mm = 9.0
    assert stream.feed().reason is HoldReason.OUTSIDE_WINDOW


def test_a_condition_that_was_left_is_entered_by_its_hysteresis_also_while_another_keeps_the_gate_inside():
    stream = armed(JoinedWindow(conditions=(CHEST, BELLY), join="or"))
    stream.good(6)
    stream.chest_mm = 2.1  # the chest leaves; the belly keeps the beam on
    assert stream.feed().state is GateState.BEAM_ON
    stream.chest_mm, stream.belly_mm = 1.9, 9.0  # back, but within its hysteresis, when the belly leaves
    assert stream.feed().state is GateState.HOLD


def test_a_frame_outside_makes_everybody_enter_anew():
    stream = armed(JoinedWindow(conditions=(CHEST, BELLY)))
    stream.chest_mm = 1.9
    assert stream.feed().state is GateState.HOLD
    stream.chest_mm = 1.4
    stream.feed()
    stream.chest_mm = 1.9
    assert stream.feed().state is GateState.DWELL
    stream.belly_mm = 9.0
    assert stream.feed().state is GateState.HOLD
    stream.belly_mm = 1.0
    assert stream.feed().state is GateState.HOLD  # the chest is within its hysteresis again


def test_a_breath_hold_settles_while_another_condition_is_not_met():
    level = AmplitudeWindow(choice=SignalChoice(signal="abdomen"), lower=0.0, upper=3.0)
    window = JoinedWindow(conditions=(BreathHoldWindow(level=level, settle_ms=300.0), CHEST))
    stream = armed(window)
    stream.chest_mm = 9.0
    assert set(stream.good(12)) == {GateState.HOLD}
    assert stream.gate.breath_holds == 1
    stream.chest_mm = 1.0
    assert stream.good(4)[-1] is GateState.BEAM_ON


def test_any_of_the_signals_may_not_jump():
    window = JoinedWindow(conditions=(replace(CHEST, upper=50.0), replace(BELLY, upper=50.0)), join="or")
    stream = Two(replace(LIMITS, window=window, max_jump_mm=1.5))
    stream.good(2)
    stream.step(Arm(operator="ann"))
    stream.good(6)
    stream.belly_mm = 2.6
    assert stream.feed().reason is HoldReason.JUMP


def test_a_bad_value_of_any_signal_faults():
    stream = armed(JoinedWindow(conditions=(CHEST, BELLY), join="or"))
    stream.belly_mm = float("nan")
    assert stream.feed().reason is HoldReason.VALUE_INVALID


def test_a_volume_is_gated_in_litres_and_the_region_still_may_not_jump():
    window = AmplitudeWindow(choice=SignalChoice(signal="volume"), lower=0.1, upper=0.3, unit="l")
    limits = replace(LIMITS, window=window)
    stream = Stream(limits)
    stream.good(2)
    stream.step(Arm(operator="ann"))
    assert stream.good(4)[-1] is GateState.BEAM_ON
    stream.level_mm += 1.6
    assert stream.feed().reason is HoldReason.JUMP


@pytest.mark.parametrize(
    ("choice", "where"),
    [
        (SignalChoice(signal="point", row=3, column=4, index=1), {"points_mm": [9.0, 1.5]}),
        (SignalChoice(signal="named", name="belly", index=2), {"named_mm": [9.0, 9.0, 1.5]}),
    ],
)
def test_points_and_named_regions_are_found_by_their_place(choice, where):
    import numpy as np

    window = AmplitudeWindow(choice=choice, lower=1.0, upper=2.0)
    stream = Stream(replace(LIMITS, window=window))
    stream.feed(measured(0, replace(motion_of(), **{name: np.array(values) for name, values in where.items()})))
    stream.step(Arm(operator="ann"))
    motion = replace(motion_of(), **{name: np.array(values) for name, values in where.items()})
    assert stream.feed(replace(stream.upcoming(), motion=motion)).state is GateState.DWELL
    missing = replace(stream.upcoming(), motion=motion_of())
    assert stream.feed(missing).reason is HoldReason.VALUE_INVALID


@pytest.mark.parametrize("conditions", [(CHEST,), (CHEST,) * 5, ()])
def test_two_to_four_are_joined(conditions):
    with pytest.raises(InvalidValueError, match="conditions"):
        JoinedWindow(conditions=conditions)


def test_only_and_and_or_join():
    with pytest.raises(InvalidValueError, match="join"):
        JoinedWindow(conditions=(CHEST, BELLY), join="xor")


def test_the_detail_is_that_of_the_first_condition_that_is_not_met():
    stream = armed(JoinedWindow(conditions=(BELLY, PhaseWindow(from_percent=30.0, to_percent=70.0))))
    assert stream.feed().detail == "the phase of this signal is not computed"


def test_as_many_conditions_as_are_allowed_make_a_window():
    conditions = tuple(replace(CHEST, lower=-1.0 - number) for number in range(MAX_CONDITIONS))
    assert JoinedWindow(conditions=conditions).leaves == conditions
    with pytest.raises(InvalidValueError):
        JoinedWindow(conditions=(*conditions, BELLY))
