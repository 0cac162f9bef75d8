"""Properties over whole sessions, checked against a rule written anew: what the last frames were decides.

The histories are built from runs of good frames with single bad things between, so most of them reach BEAM_ON; the
property also says when the beam *must* be on, so that a gate that never permits fails it too.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

from hypothesis import given, settings, strategies as st

from engine.core.commands import Acknowledge, Arm, Disarm
from engine.core.frames import MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.gating.gate import Ending, Interruption, Silence, lease_of
from tests.support.gating.bad_frames import FAULTS, HOLDS
from tests.support.gating.streams import LIMITS, MS, Stream, stream_in, unmeasured

# Gaps in host time add up to a lag, which is another rule than the one written here.
UNHURRIED = replace(LIMITS, max_lag_ms=500.0)
DWELL_NS = 100 * MS
MIN_FRAMES = 3


@dataclass
class Session:
    """A stream with jittered frame times, and the rule the gate is held against."""

    stream: Stream
    run: list[tuple[int, int]]
    is_armed: bool = False
    is_faulted: bool = False
    times_on: int = 0

    def good(self, step_ns: int) -> None:
        last = self.stream.gate.last
        frame = self.stream.upcoming()
        if last is not None:
            received_ns, timestamp_us = last.received_ns + step_ns, last.timestamp_us + step_ns // 1_000
            frame = replace(frame, received_ns=received_ns, timestamp_us=timestamp_us, queue_empty_ns=received_ns)
        self.stream.feed(frame)
        if self.is_armed:
            self.run.append((frame.received_ns, frame.timestamp_us))
        self.check()

    def bad(self, name: str) -> None:
        self.run.clear()
        is_fault = name in FAULTS
        spoil, _reason = FAULTS[name] if is_fault else HOLDS[name]
        if self.stream.gate.last is None:
            return
        last, frame = self.stream.gate.last, self.stream.upcoming()
        on_time = replace(frame, received_ns=last.received_ns + 33_367_000, timestamp_us=last.timestamp_us + 33_367)
        self.stream.feed(spoil(on_time))
        self.is_faulted |= is_fault
        self.is_armed &= not is_fault
        self.check()

    def silent(self, silence_ms: int) -> None:
        self.run.clear()
        last = self.stream.gate.last
        if last is None:
            return
        self.stream.step(Silence(since_ns=0), last.received_ns + silence_ms * MS)
        if silence_ms > 500:
            self.is_faulted, self.is_armed = True, False
        self.check()

    def arm(self) -> None:
        self.run.clear()
        self.stream.step(Arm(operator="ann"))
        self.is_armed |= not self.is_faulted
        self.check()

    def disarm(self) -> None:
        self.run.clear()
        self.stream.step(Disarm(operator="ann"))
        self.is_armed = False
        self.check()

    def acknowledge(self) -> None:
        self.run.clear()
        self.stream.step(Acknowledge(operator="ann"))
        self.is_faulted = False
        self.check()

    def interrupt(self, reason: HoldReason) -> None:
        self.run.clear()
        self.stream.step(Interruption(reason))
        if reason.is_fault:
            self.is_faulted, self.is_armed = True, False
        self.check()

    def check(self) -> None:
        """The beam is on exactly when the frames since anything else were enough, and long enough."""
        gate = self.stream.gate
        must_be_on = (
            self.is_armed
            and len(self.run) >= MIN_FRAMES
            and self.run[-1][0] - self.run[0][0] >= DWELL_NS
            and (self.run[-1][1] - self.run[0][1]) * 1_000 >= DWELL_NS
        )
        assert (gate.state is GateState.BEAM_ON) is must_be_on
        assert gate.is_armed is self.is_armed
        assert (gate.state is GateState.FAULT) is self.is_faulted
        lease = lease_of(gate, decided_ns=self.stream.now_ns, sequence=0, limits=LIMITS)
        assert (lease is not None) is must_be_on
        self.times_on += must_be_on


steps_ns = st.integers(20 * MS, 60 * MS)
runs: st.SearchStrategy[Callable[[Session], None]] = st.lists(steps_ns, min_size=1, max_size=9).map(
    lambda steps: lambda session: [session.good(step) for step in steps]
)
bad_things = st.one_of(
    st.sampled_from(sorted(HOLDS)).map(lambda name: lambda session: session.bad(name)),
    st.sampled_from(sorted(FAULTS)).map(lambda name: lambda session: session.bad(name)),
    st.integers(60, 900).map(lambda ms: lambda session: session.silent(ms)),
    st.sampled_from(list(HoldReason)).map(lambda reason: lambda session: session.interrupt(reason)),
    st.sampled_from([Session.arm, Session.disarm, Session.acknowledge]),
)
recoveries = st.sampled_from([[Session.acknowledge, Session.arm], [Session.arm], []])


@settings(max_examples=300, deadline=None)
@given(st.lists(st.tuples(bad_things, recoveries, runs), min_size=1, max_size=6))
def test_the_beam_is_on_exactly_after_a_full_dwell_of_good_frames_in_an_armed_gate(chapters):
    session = Session(stream=Stream(UNHURRIED), run=[])
    session.good(30 * MS)
    session.arm()
    for _ in range(6):
        session.good(33 * MS)
    assert session.times_on > 0  # nothing here holds vacuously
    for bad_thing, recovery, run in chapters:
        bad_thing(session)
        for act in recovery:
            act(session)
        run(session)


commands = st.sampled_from([Arm(operator="eve"), Disarm(operator="eve"), Acknowledge(operator="eve")])
other_events = st.one_of(
    commands,
    st.sampled_from(list(HoldReason)).map(Interruption),
    st.sampled_from(list(HoldReason)).map(Ending),
    st.just(Silence(since_ns=0)),
)


@settings(max_examples=150, deadline=None)
@given(st.sampled_from(list(GateState)), st.lists(other_events, min_size=1, max_size=40))
def test_no_sequence_of_commands_turns_the_beam_on_without_frames(state, events):
    stream = stream_in(state)
    for event in events:
        assert stream.step(event).state is not GateState.BEAM_ON


@settings(max_examples=100, deadline=None)
@given(st.lists(st.tuples(commands, st.sampled_from(sorted(HOLDS))), min_size=1, max_size=20))
def test_no_sequence_of_commands_turns_the_beam_on_with_bad_frames(acts):
    stream = stream_in(GateState.HOLD)
    for command, name in acts:
        assert stream.step(command).state is not GateState.BEAM_ON
        spoil, _reason = HOLDS[name]
        assert stream.feed(spoil(stream.upcoming())).state is not GateState.BEAM_ON


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(sorted(HOLDS)), st.lists(steps_ns, min_size=1, max_size=12))
def test_any_bad_frame_costs_a_full_dwell(name, steps):
    session = Session(stream=stream_in(GateState.BEAM_ON), run=[], is_armed=True)
    session.bad(name)
    start_ns = session.stream.gate.last.received_ns
    for step_ns in steps:
        session.good(step_ns)
        if session.stream.gate.state is GateState.BEAM_ON:
            assert session.stream.gate.last.received_ns - start_ns > DWELL_NS


def test_a_training_frame_between_two_short_runs_adds_them_up_to_nothing():
    stream = stream_in(GateState.HOLD)
    for _ in range(10):
        assert stream.good(3) == [GateState.DWELL] * 3
        stream.feed(unmeasured(stream.upcoming(), MeasurementState.TRAINING))
