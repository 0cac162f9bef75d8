"""Without a head direction only the whole region and its volume gate: any other signal may be another part's."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.breath import GateSignal, SignalChoice
from engine.core.commands import Arm
from engine.core.gate_state import GateState, HoldReason
from engine.core.signals import HeadDirection, depends_on_head
from engine.gating.windows import AmplitudeWindow, GateWindow, Join, JoinedWindow, PhaseWindow, Unit
from tests.support.gating.streams import LIMITS, Stream, measured, motion_of, stream_in

CHOICES = {
    GateSignal.WHOLE: SignalChoice(),
    GateSignal.VOLUME: SignalChoice(signal="volume"),
    GateSignal.THORAX: SignalChoice(signal="thorax"),
    GateSignal.ABDOMEN: SignalChoice(signal="abdomen"),
    GateSignal.REGION: SignalChoice(signal="region", row=13, column=7),
    GateSignal.NAMED: SignalChoice(signal="named", name="belly"),
    GateSignal.POINT: SignalChoice(signal="point", row=3, column=4),
}
MAY = {GateSignal.WHOLE, GateSignal.VOLUME}
MOTION = replace(motion_of(), points_mm=np.ones(1), named_mm=np.ones(1))


def on(choice: SignalChoice) -> AmplitudeWindow:
    return AmplitudeWindow(choice=choice, lower=-1.0, upper=3.0, unit=Unit.L if choice.is_volume else Unit.MM)


def beam_of(window: GateWindow, head: HeadDirection | None):
    """The gate after ten good frames that are inside the window."""
    stream = Stream(replace(LIMITS, window=window, head_direction=head))
    stream.step(Arm(operator="ann"))
    for _ in range(10):
        stream.feed(replace(stream.upcoming(), motion=MOTION))
    return stream.gate


def test_every_signal_is_named_here():
    assert set(CHOICES) == set(GateSignal)


@pytest.mark.parametrize("signal", GateSignal)
def test_only_the_whole_region_and_its_volume_gate_without_a_head_direction(signal):
    gate = beam_of(on(CHOICES[signal]), None)
    assert depends_on_head(CHOICES[signal]) is (signal not in MAY)
    if signal in MAY:
        assert gate.state is GateState.BEAM_ON
    else:
        assert (gate.state, gate.reason) == (GateState.HOLD, HoldReason.HEAD_DIRECTION_MISSING)
        assert "head direction" in gate.detail


@pytest.mark.parametrize("signal", GateSignal)
@pytest.mark.parametrize("head", HeadDirection)
def test_every_signal_gates_with_a_head_direction(signal, head):
    assert beam_of(on(CHOICES[signal]), head).state is GateState.BEAM_ON


@pytest.mark.parametrize("join", Join)
def test_one_part_of_the_patient_in_a_joined_window_needs_the_head_direction(join):
    window = JoinedWindow(conditions=(on(CHOICES[GateSignal.WHOLE]), on(CHOICES[GateSignal.THORAX])), join=join)
    assert beam_of(window, None).reason is HoldReason.HEAD_DIRECTION_MISSING
    assert beam_of(window, HeadDirection.BOTTOM).state is GateState.BEAM_ON


def test_a_window_on_the_phase_of_a_part_needs_the_head_direction():
    window = PhaseWindow(choice=CHOICES[GateSignal.ABDOMEN], from_percent=0.0, to_percent=50.0, min_confidence=0.5)
    assert replace(LIMITS, window=window, head_direction=None).needs_head_direction
    assert beam_of(window, None).reason is HoldReason.HEAD_DIRECTION_MISSING


def test_a_beam_that_is_on_goes_off_with_the_first_frame_without_a_head_direction():
    stream = stream_in(GateState.BEAM_ON, limits=replace(LIMITS, window=on(CHOICES[GateSignal.THORAX])))
    stream.limits = replace(stream.limits, head_direction=None)
    assert stream.feed().reason is HoldReason.HEAD_DIRECTION_MISSING


def test_a_value_that_is_no_number_faults_before_the_head_direction_holds():
    stream = Stream(replace(LIMITS, window=on(CHOICES[GateSignal.THORAX]), head_direction=None))
    frame = replace(measured(0), motion=motion_of(thorax_mm=float("nan")))
    assert stream.feed(frame).reason is HoldReason.VALUE_INVALID


def test_the_opposite_side_is_the_opposite_direction():
    for side in HeadDirection:
        assert side.opposite.opposite is side
        assert side.superior_px == tuple(-part for part in side.opposite.superior_px)
        assert sum(abs(part) for part in side.superior_px) == 1.0
    assert HeadDirection.TOP.superior_px == (0.0, -1.0)
    assert HeadDirection.LEFT.superior_px == (-1.0, 0.0)
