"""The transition table: every pair of a state and an event kind, as looked up and as reached by real events."""

import itertools
from dataclasses import replace

import pytest

from engine.core.commands import Acknowledge, Arm, Disarm
from engine.core.frames import MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.gating.gate import TRANSITIONS, Ending, EventKind, Gate, Interruption, Silence, next_state
from tests.support.gating.streams import MS, Stream, motion_of, stream_in, unmeasured

# Written by hand from design.md, not from the code: what each row of the table must say, in this order of kinds.
KINDS = ["inside", "dwelt", "outside", "unusable", "failure", "arm", "disarm", "acknowledge", "end"]
EXPECTED = {
    "disarmed": "disarmed disarmed disarmed disarmed fault hold disarmed disarmed disarmed",
    "hold": "dwell hold hold hold fault hold disarmed hold disarmed",
    "dwell": "dwell beam_on hold hold fault hold disarmed hold disarmed",
    "beam_on": "hold beam_on hold hold fault hold disarmed hold disarmed",
    "fault": "fault fault fault fault fault fault fault disarmed fault",
}
PAIRS = [
    (GateState(state), EventKind(kind), GateState(to))
    for state, row in EXPECTED.items()
    for kind, to in zip(KINDS, row.split(), strict=True)
]


def _named(value: object) -> str:
    return str(value)


def test_the_expectation_covers_every_pair_of_state_and_kind():
    assert {(state, kind) for state, kind, _ in PAIRS} == {(state, kind) for state in GateState for kind in EventKind}


@pytest.mark.parametrize(("state", "kind", "expected"), PAIRS, ids=_named)
def test_every_pair_of_state_and_event_leads_where_the_design_states(state, kind, expected):
    assert next_state(state, kind) is expected


def by_rule(state: str, kind: str) -> str:
    """Where a pair leads, by the rules in words: read from no table, the code's or the one above."""
    if state == "fault":  # a fault stays until a person has seen it, which arms no one
        return "disarmed" if kind == "acknowledge" else "fault"
    if kind == "failure":
        return "fault"
    if state == "disarmed":  # nothing but a person's arming asks the gate to decide
        return "hold" if kind == "arm" else "disarmed"
    if kind in {"disarm", "end"}:
        return "disarmed"
    first_steps = "hold" if state == "beam_on" else "dwell"
    last_step = "hold" if state == "hold" else "beam_on"
    return {"inside": first_steps, "dwelt": last_step}.get(kind, "hold")


@pytest.mark.parametrize("state", GateState, ids=_named)
@pytest.mark.parametrize("kind", EventKind, ids=_named)
def test_every_pair_leads_where_the_rules_in_words_say(state, kind):
    assert str(next_state(state, kind)) == by_rule(str(state), str(kind)) == EXPECTED[state].split()[KINDS.index(kind)]


@pytest.mark.parametrize("state", GateState, ids=_named)
def test_no_cell_of_the_table_can_be_changed_unseen(state, monkeypatch):
    """A mutation of the table, cell by cell: the rules in words tell each from the table as it is."""
    for kind, other in itertools.product(EventKind, GateState):
        before = str(next_state(state, kind))
        with monkeypatch.context() as changed:
            changed.setitem(TRANSITIONS, (state, kind), other)
            seen = {(one, two) for one in GateState for two in EventKind if next_state(one, two) != by_rule(one, two)}
        assert seen == ({(state, kind)} if str(other) != before else set())


def test_a_pair_that_is_not_in_the_table_is_hold_or_stays_where_no_beam_can_be():
    for state in GateState:
        for kind in set(EventKind) - {known for known_state, known in TRANSITIONS if known_state is state}:
            stays = state in {GateState.DISARMED, GateState.FAULT}
            assert next_state(state, kind) is (state if stays else GateState.HOLD)


def test_only_dwell_and_beam_on_itself_lead_to_beam_on():
    sources = {state for (state, _), to in TRANSITIONS.items() if to is GateState.BEAM_ON}
    assert sources == {GateState.DWELL, GateState.BEAM_ON}
    assert {kind for (_, kind), to in TRANSITIONS.items() if to is GateState.BEAM_ON} == {EventKind.DWELT}


def _feed_inside(stream: Stream) -> Gate:
    return stream.feed()


def _feed_outside(stream: Stream) -> Gate:
    return stream.feed(replace(stream.upcoming(), motion=motion_of(3.2)))


def _feed_unusable(stream: Stream) -> Gate:
    return stream.feed(unmeasured(stream.upcoming(), MeasurementState.TRAINING))


def _be_silent(stream: Stream) -> Gate:
    return stream.step(Silence(since_ns=0), stream.now_ns + 60 * MS)


def _feed_inside_after_a_full_dwell(stream: Stream) -> Gate:
    """Forge what the run of frames has lasted; in `hold` and elsewhere that cannot be, and must lead nowhere."""
    frame = stream.upcoming()
    long_ago_ns, long_ago_us = frame.received_ns - 10**10, frame.timestamp_us - 10**7
    stream.gate = replace(
        stream.gate, good_frames=99, inside_since_ns=long_ago_ns, inside_since_us=long_ago_us, off_since_ns=None
    )
    return stream.feed(frame)


def _feed_inside_as_the_first(stream: Stream) -> Gate:
    """Forget the run of frames; in `beam_on` that cannot be, and must hold."""
    stream.gate = replace(stream.gate, good_frames=0, inside_since_ns=None, inside_since_us=None)
    return stream.feed()


REAL_EVENTS = {
    "inside": [("a frame inside", _feed_inside_as_the_first)],
    "dwelt": [("a frame inside that ends a dwell", _feed_inside_after_a_full_dwell)],
    "outside": [("a frame outside", _feed_outside)],
    "unusable": [
        ("a training frame", _feed_unusable),
        ("silence", _be_silent),
        ("a hold from elsewhere", lambda stream: stream.step(Interruption(HoldReason.MODEL_MISSING))),
    ],
    "failure": [("a fault", lambda stream: stream.step(Interruption(HoldReason.DISK_LOW)))],
    "arm": [("arm", lambda stream: stream.step(Arm(operator="ann")))],
    "disarm": [("disarm", lambda stream: stream.step(Disarm(operator="ann")))],
    "acknowledge": [("acknowledge", lambda stream: stream.step(Acknowledge(operator="ann")))],
    "end": [("the end", lambda stream: stream.step(Ending(HoldReason.SOURCE_ENDED)))],
}
REAL_PAIRS = [
    pytest.param(state, make, GateState(row.split()[KINDS.index(kind)]), id=f"{state}-{name}")
    for state, row in EXPECTED.items()
    for kind, makers in REAL_EVENTS.items()
    for name, make in makers
]


@pytest.mark.parametrize(("state", "make", "expected"), REAL_PAIRS)
def test_a_real_event_in_a_gate_that_really_got_there_leads_where_the_design_states(state, make, expected):
    assert make(stream_in(GateState(state))).state is expected


@pytest.mark.parametrize(
    ("state", "expected"),
    [("disarmed", "disarmed"), ("hold", "dwell"), ("dwell", "dwell"), ("beam_on", "beam_on"), ("fault", "fault")],
)
def test_a_good_frame_inside_leads_one_step_further_and_never_straight_to_the_beam(state, expected):
    assert _feed_inside(stream_in(GateState(state))).state is GateState(expected)


def test_something_that_is_no_event_faults_as_unknown():
    gate = stream_in(GateState.BEAM_ON).step("turn on")
    assert (gate.state, gate.reason) == (GateState.FAULT, HoldReason.UNKNOWN)


@pytest.mark.parametrize("state", GateState, ids=_named)
def test_a_reason_to_hold_is_given_in_every_state_but_beam_on(state):
    gate = stream_in(state).gate
    assert (gate.reason is None) is (state is GateState.BEAM_ON)
