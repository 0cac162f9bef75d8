"""Who lets the gate decide: one name, kept by the gate from arming to disarming."""

import pytest

from engine.core.commands import Acknowledge, Arm, Disarm, ReleaseBeam
from engine.core.gate_state import GateState, HoldReason
from engine.gating.gate import Ending, Interruption, Silence
from engine.gating.limits import ns_from_ms
from tests.support.gating.streams import LIMITS, stream_in

ARMED = (GateState.HOLD, GateState.DWELL, GateState.BEAM_ON)


@pytest.mark.parametrize("state", GateState)
def test_an_armed_gate_and_no_other_names_who_armed_it(state):
    assert (stream_in(state).gate.armed_by == "ann") is (state in ARMED)
    assert (stream_in(state).gate.armed_by is None) is (state not in ARMED)


@pytest.mark.parametrize("state", ARMED)
@pytest.mark.parametrize(
    "event",
    [
        Disarm(operator="bob"),
        Ending(HoldReason.ENGINE_STOPPED),
        Interruption(HoldReason.SOURCE_LOST),
        Interruption(HoldReason.SERVICE_SILENT),
    ],
    ids=str,
)
def test_what_ends_the_arming_ends_the_name(state, event):
    assert stream_in(state).step(event).armed_by is None


@pytest.mark.parametrize("state", ARMED)
def test_a_frame_that_latches_the_gate_ends_the_name(state):
    stream = stream_in(state)
    late = stream.feed(age_ns=ns_from_ms(LIMITS.max_silence_ms) + 1)
    assert (late.state, late.armed_by) == (GateState.FAULT, None)


@pytest.mark.parametrize("state", ARMED)
@pytest.mark.parametrize(
    "event",
    [
        Interruption(HoldReason.OPERATOR_HOLD, "held by bob"),
        Interruption(HoldReason.OPERATOR_LOST),
        Silence(since_ns=0),
        Acknowledge(operator="bob"),
        Arm(operator="bob"),
    ],
    ids=str,
)
def test_a_hold_or_another_s_command_keeps_the_name(state, event):
    stream = stream_in(state)
    assert stream.step(event).armed_by == "ann"
    stream.good(6)
    assert stream.gate.armed_by == "ann"


@pytest.mark.parametrize(("is_person", "name"), [(True, "bob"), (False, "ann")])
@pytest.mark.parametrize("state", ARMED)
def test_a_person_who_releases_takes_over_and_a_program_does_not(state, is_person, name):
    stream = stream_in(state)
    released = stream.step(ReleaseBeam(operator="bob", is_person=is_person))
    assert (released.state, released.reason, released.armed_by) == (GateState.HOLD, HoldReason.DWELL, name)
    assert released.detail == "released by bob"
    stream.good(6)
    assert (stream.gate.state, stream.gate.armed_by) == (GateState.BEAM_ON, name)


@pytest.mark.parametrize("state", [GateState.DISARMED, GateState.FAULT])
def test_a_release_arms_nothing(state):
    released = stream_in(state).step(ReleaseBeam(operator="bob"))
    assert (released.state, released.armed_by) == (state, None)


@pytest.mark.parametrize(("is_person", "by_program"), [(True, False), (False, True)])
def test_a_person_s_release_takes_a_program_s_gate_over_and_its_end_is_that_of_the_program(is_person, by_program):
    stream = stream_in(GateState.DISARMED)
    assert stream.step(Arm(operator="key:planning", is_person=False)).is_armed_by_program
    assert stream.step(ReleaseBeam(operator="bob", is_person=is_person)).is_armed_by_program is by_program
    stream = stream_in(GateState.DISARMED)
    stream.step(Arm(operator="key:planning", is_person=False))
    gate = stream.step(Disarm(operator="bob"))
    assert (gate.armed_by, gate.is_armed_by_program) == (None, False)


def test_a_command_that_is_no_release_has_no_words():
    stream = stream_in(GateState.DISARMED)
    assert stream.step(Arm(operator="ann")).detail == ""
