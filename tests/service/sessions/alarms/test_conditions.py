"""What of a view is an alarm: faults always, holds of an armed gate, and the accelerator's beam whatever is latched."""

from dataclasses import replace

import pytest

from engine.beam.beam_on import BeamOnState
from engine.control.outputs import LiveView
from engine.core.gate_state import GateState, HoldReason
from service.core.alarm_table import ALARMS, NOT_ALARMS
from service.sessions.alarms.board import gate_conditions, site_conditions
from tests.support.service.fake_engine import FakeRunning

HOLDS = sorted(reason for reason in HoldReason if not reason.is_fault)
FAULTS = sorted(reason for reason in HoldReason if reason.is_fault)


def view(state: GateState, reason: HoldReason | None = None, *, beam_on: BeamOnState | None = None) -> LiveView:
    running = FakeRunning(plan=None)
    running.gate = state
    record = replace(running.frame(), gate_state=state, hold_reason=reason)
    return replace(running.latest, record=record, detail="12 mm", beam_on=beam_on)


@pytest.mark.parametrize("reason", HOLDS)
def test_a_hold_is_an_alarm_only_while_armed_and_only_where_the_table_has_it(reason: HoldReason):
    armed = gate_conditions(view(GateState.HOLD, reason))
    assert armed == ({} if reason in NOT_ALARMS else {reason.value: "12 mm"})
    assert gate_conditions(view(GateState.DISARMED, reason)) == {}


@pytest.mark.parametrize("reason", FAULTS)
def test_a_latched_fault_is_an_alarm_of_its_reason_and_an_unlisted_one_is_the_most_urgent(reason: HoldReason):
    code = "unknown" if reason in NOT_ALARMS else reason.value
    assert gate_conditions(view(GateState.FAULT, reason)) == {code: "12 mm"}
    assert ALARMS[code].latches


def test_a_fault_with_the_reason_of_a_hold_or_with_none_is_the_unknown_alarm():
    assert gate_conditions(view(GateState.FAULT, HoldReason.MARKER_LOST)) == {"unknown": "12 mm"}
    assert gate_conditions(view(GateState.FAULT, None)) == {"unknown": "12 mm"}


def test_gating_and_beam_on_are_no_alarm():
    assert gate_conditions(view(GateState.BEAM_ON)) == {}
    assert gate_conditions(view(GateState.DWELL, HoldReason.DWELL)) == {}


@pytest.mark.parametrize("state", [GateState.DISARMED, GateState.FAULT, GateState.HOLD])
def test_a_beam_without_a_permit_is_an_alarm_whatever_else_is_latched(state: GateState):
    beam = BeamOnState(is_on=True, violation="beam on 300 ms after the permit ended")
    found = gate_conditions(view(state, HoldReason.SOURCE_LOST, beam_on=beam))
    assert found["beam_without_permit"] == "beam on 300 ms after the permit ended"
    assert ("source_lost" in found) is (state is GateState.FAULT)


def test_a_permit_without_a_beam_is_an_alarm_while_armed():
    absent = BeamOnState(is_on=False, is_absent=True)
    assert gate_conditions(view(GateState.BEAM_ON, beam_on=absent)) == {"permit_without_beam": ""}
    assert gate_conditions(view(GateState.DISARMED, HoldReason.DISARMED, beam_on=absent)) == {}


def test_troubles_of_the_service_are_alarms_with_their_sentences():
    assert site_conditions(["the anchors cannot be written"], ["armed-operator"]) == {
        "audit_trouble": "the anchors cannot be written",
        "thread_ended": "armed-operator",
    }
    assert site_conditions([], ()) == {}
