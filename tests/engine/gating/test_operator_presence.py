"""Presence by itself: one person's message takes nothing from another's, and the timeout itself is in time."""

from dataclasses import replace

import pytest

from engine.core.clock import ManualClock
from engine.core.gate_state import GateState
from engine.gating.interlocks import MOST_PERSONS, OperatorPresence
from tests.support.gating.streams import stream_in

GATE = replace(stream_in(GateState.BEAM_ON).gate, armed_by="ann")
TIMEOUT_NS = 2_000_000_000


def test_another_person_s_message_does_not_end_the_presence_of_the_one_who_armed():
    clock = ManualClock(5)
    presence = OperatorPresence(clock=clock, timeout_s=2.0)
    for person in ("ann", "bob", "cy"):
        presence.note(person)
    assert presence.absence(GATE, clock.now_ns()) == ""


def test_beyond_the_most_persons_all_but_the_newest_are_forgotten():
    clock = ManualClock(5)
    presence = OperatorPresence(clock=clock, timeout_s=2.0)
    presence.note("ann")
    for number in range(MOST_PERSONS - 1):
        presence.note(f"person {number}")
    presence.note("person 0")
    assert presence.absence(GATE, clock.now_ns()) == ""
    presence.note("one more")
    assert presence.absence(GATE, clock.now_ns()) == "no message from ann"
    assert presence.absence(replace(GATE, armed_by="one more"), clock.now_ns()) == ""


@pytest.mark.parametrize("timeout_ns", [TIMEOUT_NS, 1])
def test_a_message_counts_until_the_timeout_itself(timeout_ns):
    clock = ManualClock(5)
    presence = OperatorPresence(clock=clock, timeout_s=timeout_ns / 1e9)
    assert presence.absence(GATE, 5) == "no message from ann"
    presence.note("ann")
    assert presence.absence(GATE, 5 + timeout_ns) == ""
    assert presence.absence(GATE, 6 + timeout_ns).startswith("no message from ann for ")
