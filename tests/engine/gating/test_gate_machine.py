"""The gate as a state machine against a plain reading of its rules: any events, in any order, at any times.

Each step is stated as a fact, asked to the gate as an event and to the oracle as itself; both must then agree on where
the gate is. The histories are made so that most of them have the beam on, again and again, and that is asserted too.
"""

from collections import Counter
from dataclasses import replace
from typing import ClassVar

import pytest
from hypothesis import HealthCheck, event, settings, strategies as st, target
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from engine.core.commands import Acknowledge, Arm, Disarm
from engine.core.frames import LostReason, Measurement, MeasurementState
from engine.core.gate_state import GateState, HoldReason
from engine.gating.gate import Ending, Gate, Interruption, Silence, lease_of, step_gate
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from tests.support.gating.bad_frames import FAULTS
from tests.support.gating.gate_oracle import LATCHING, MS, Oracle, Rules
from tests.support.gating.streams import measured, motion_of, stream_in, unmeasured

START_NS = 10_000 * MS
NONSENSE = sorted(
    name for name, (_, reason) in FAULTS.items() if reason is HoldReason.VALUE_INVALID and "missed" not in name
)
OTHERS = st.sampled_from([object(), "turn on", None, 1, Arm, GateState.BEAM_ON])
UNTRUSTED = st.sampled_from(
    [
        lambda frame: unmeasured(frame, MeasurementState.TRAINING),
        lambda frame: unmeasured(frame, MeasurementState.LOST, LostReason.MARKER_LOST),
        lambda frame: replace(frame, motion=motion_of(frame.motion.whole_mm, residual_mm=3.1)),
        lambda frame: replace(frame, motion=motion_of(frame.motion.whole_mm, valid_share=0.7)),
        lambda frame: replace(frame, missed_frames=1),
        lambda frame: replace(frame, frame_index=frame.frame_index + 1),
    ]
)
rules_of_a_site = st.builds(
    Rules,
    dwell_ns=st.sampled_from([0, 50, 100, 150]).map(lambda ms: ms * MS),
    least_frames=st.integers(2, 5),
    lease_ns=st.sampled_from([60, 80, 120]).map(lambda ms: ms * MS),
    shortest_on_ns=st.sampled_from([0, 0, 60, 300]).map(lambda ms: ms * MS),
    shortest_off_ns=st.sampled_from([0, 0, 150, 400]).map(lambda ms: ms * MS),
    cycles_a_minute=st.sampled_from([120, 120, 2, 4]),
)
steps_ns = st.integers(20 * MS, 55 * MS)
slower_us = st.sampled_from([0, 0, 0, 2_000])
"""How much less than the host's clock the camera's goes on in a step."""

prompt_ns = st.integers(0, 20 * MS)
levels_mm = st.sampled_from([2.0, 0.0, 2.8, -0.8])
edges_mm = st.sampled_from([-1.0, -0.9, 2.9, 3.0])
outside_mm = st.sampled_from([-1.01, 3.01, 5.0, -4.0])


def limits_of(rules: Rules) -> GateLimits:
    """The same numbers as the engine takes them; what is not ruled here is as wide as it may be."""
    return GateLimits(
        window=amplitude_window(lower_mm=rules.lower_mm, upper_mm=rules.upper_mm, hysteresis_mm=rules.margin_mm),
        dwell_ms=rules.dwell_ns / MS,
        min_good_frames=rules.least_frames,
        lease_ms=rules.lease_ns / MS,
        max_frame_age_ms=rules.oldest_ns / MS,
        max_gap_ms=rules.longest_gap_ns / MS,
        max_silence_ms=rules.longest_silence_ns / MS,
        min_on_ms=rules.shortest_on_ns / MS,
        min_off_ms=rules.shortest_off_ns / MS,
        max_cycles_per_min=rules.cycles_a_minute,
        max_jump_mm=20.0,
        max_lag_ms=500.0,
        max_latency_ms=1_000.0,
    )


class GateMachine(RuleBasedStateMachine):
    """One session of one gate."""

    reached: ClassVar[Counter[str]] = Counter()

    def __init__(self) -> None:
        super().__init__()
        self.gate = Gate()
        self.oracle = Oracle(rules=Rules())
        self.limits = limits_of(self.oracle.rules)
        self.now_ns = START_NS
        self.index = 0
        self.times_on = 0

    @initialize(rules=rules_of_a_site, frames=st.integers(6, 10), is_armed=st.sampled_from([True] * 14 + [False]))
    def begin(self, rules: Rules, frames: int, is_armed: bool) -> None:
        self.oracle = Oracle(rules=rules)
        self.limits = limits_of(rules)
        self._frame(33 * MS, 5 * MS, 2.0)
        if is_armed:
            self.arm()
        for _ in range(frames):
            self._frame(33 * MS, 5 * MS, 2.0)

    # Frames.

    @rule(steps=st.lists(st.tuples(steps_ns, prompt_ns, levels_mm, slower_us), min_size=1, max_size=8))
    def good_frames(self, steps: list[tuple[int, int, float, int]]) -> None:
        for step_ns, age_ns, level_mm, behind_us in steps:
            frame = self._next(step_ns, level_mm)
            frame = replace(frame, timestamp_us=frame.timestamp_us - behind_us)
            self._tell_frame(frame, age_ns, level_mm=level_mm)

    @rule(step_ns=steps_ns, age_ns=prompt_ns, level_mm=edges_mm)
    def a_frame_between_the_edges_of_entering_and_leaving(self, step_ns: int, age_ns: int, level_mm: float) -> None:
        self._frame(step_ns, age_ns, level_mm)

    @rule(step_ns=steps_ns, age_ns=prompt_ns, level_mm=outside_mm)
    def a_frame_outside(self, step_ns: int, age_ns: int, level_mm: float) -> None:
        self._frame(step_ns, age_ns, level_mm)

    @rule(step_ns=steps_ns, age_ns=st.integers(40, 620).map(lambda ms: ms * MS))
    def a_frame_decided_on_late(self, step_ns: int, age_ns: int) -> None:
        self._frame(step_ns, age_ns, 2.0)

    @rule(step_ns=st.sampled_from([60, 61, 79, 80, 81, 300, 20_000, 61_000]).map(lambda ms: ms * MS))
    def a_frame_after_a_gap(self, step_ns: int) -> None:
        self._frame(step_ns, 5 * MS, 2.0)

    @precondition(lambda self: self.oracle.is_on)
    @rule(step_ns=st.sampled_from([45, 50, 55, 60]).map(lambda ms: ms * MS), beyond_ns=st.sampled_from([-1, 0, 1, MS]))
    def a_good_frame_about_the_end_of_the_lease(self, step_ns: int, beyond_ns: int) -> None:
        """A line that lapsed is off: it must not be on again without a dwell, however good the frame."""
        self._frame(step_ns, max(self.oracle.rules.lease_ns - step_ns + beyond_ns, 0), 2.0)

    @rule(step_ns=steps_ns, spoil=UNTRUSTED)
    def a_frame_not_to_be_trusted(self, step_ns: int, spoil) -> None:
        frame = self._next(step_ns, 2.0)
        self._tell_frame(spoil(frame), 5 * MS, level_mm=None)

    @rule(step_ns=steps_ns, name=st.sampled_from(NONSENSE))
    def a_frame_that_cannot_be(self, step_ns: int, name: str) -> None:
        frame = self._next(step_ns, 2.0)
        self._tell_frame(FAULTS[name][0](frame), 5 * MS, level_mm=None, is_nonsense=True)

    @rule(
        step_ns=st.sampled_from([0, -1, -40 * MS]),
        name=st.sampled_from(["received", "captured", "index", "missed", "future"]),
    )
    def a_frame_of_the_past(self, step_ns: int, name: str) -> None:
        """It is refused for good, and the next is compared with it: begin anew behind it, as a camera does."""
        last = self.gate.last
        assert last is not None
        frame = self._next(33 * MS, 2.0)
        if name == "received":
            frame = replace(frame, received_ns=last.received_ns + step_ns)
        elif name == "captured":
            frame = replace(frame, timestamp_us=last.timestamp_us + step_ns // 1_000)
        elif name == "missed":
            frame = replace(frame, missed_frames=-1)
        elif name == "future":
            ahead_ns = max(self.now_ns - frame.received_ns, 0) + 7 * MS
            captured_us = frame.timestamp_us + ahead_ns // 1_000
            frame = replace(frame, received_ns=frame.received_ns + ahead_ns, timestamp_us=captured_us)
        else:
            frame = replace(frame, frame_index=last.index + min(step_ns, 0) // (40 * MS))
        age_ns = -6 * MS if name == "future" else 5 * MS
        self._tell_frame(frame, age_ns, level_mm=None, is_disorder=True)

    # Time, people, and the rest of the engine.

    @rule(silent_ns=st.sampled_from([0, 30, 59, 60, 61, 200, 499, 500, 501, 9_000]).map(lambda ms: ms * MS))
    def silence(self, silent_ns: int) -> None:
        last = self.gate.last
        assert last is not None
        self.now_ns = max(self.now_ns, last.received_ns + silent_ns)
        self._tell(Silence(since_ns=0))
        self.oracle.silence(self.now_ns)

    @rule()
    def arm(self) -> None:
        self._tell(Arm(operator="ann"))
        self.oracle.arm(self.now_ns)

    @precondition(lambda self: not self.oracle.is_armed)
    @rule(frames=st.integers(2, 8))
    def clear_arm_and_wait(self, frames: int) -> None:
        """As a person does who wants the beam back."""
        self.acknowledge()
        self.arm()
        for _ in range(frames):
            self._frame(33 * MS, 5 * MS, 2.0)

    @rule()
    def disarm(self) -> None:
        self._tell(Disarm(operator="ann"))
        self.oracle.disarm(self.now_ns)

    @rule()
    def acknowledge(self) -> None:
        self._tell(Acknowledge(operator="ann"))
        self.oracle.acknowledge(self.now_ns)

    @rule(reason=st.sampled_from(list(HoldReason)))
    def an_interruption(self, reason: HoldReason) -> None:
        self._tell(Interruption(reason))
        (self.oracle.fault if str(reason) in LATCHING else self.oracle.hold)(self.now_ns)

    @rule(reason=st.sampled_from(list(HoldReason)))
    def the_end(self, reason: HoldReason) -> None:
        self._tell(Ending(reason))
        self.oracle.disarm(self.now_ns)

    @rule(other=OTHERS)
    def something_unknown(self, other: object) -> None:
        self._tell(other)
        self.oracle.fault(self.now_ns)

    # What must be so after every step.

    @invariant()
    def the_gate_is_where_a_plain_reading_of_the_rules_says(self) -> None:
        assert str(self.gate.state) == self.oracle.state, (self.gate.reason, self.gate.detail)

    @invariant()
    def a_reason_is_given_exactly_where_the_beam_is_not_on(self) -> None:
        assert (self.gate.reason is None) is (self.gate.state is GateState.BEAM_ON)

    @invariant()
    def a_lease_is_given_in_beam_on_alone_and_ends_counted_from_the_newest_frame_s_receipt(self) -> None:
        lease = lease_of(self.gate, decided_ns=self.now_ns, sequence=7, limits=self.limits)
        assert (lease is not None) is self.oracle.is_on
        if lease is not None:
            assert lease.expires_ns == self.oracle.last[0] + self.oracle.rules.lease_ns
            assert (lease.granted_ns, lease.sequence) == (self.now_ns, 7)

    def teardown(self) -> None:
        event(f"on {min(self.times_on, 3)} times")
        target(float(min(self.times_on, 10)))
        self.reached["histories"] += 1
        self.reached["on"] += self.times_on > 0
        self.reached["on again"] += self.times_on > 1

    # How facts become events.

    def _next(self, step_ns: int, level_mm: float) -> Measurement:
        last = self.gate.last
        self.index += 1
        received_ns = START_NS if last is None else last.received_ns + step_ns
        captured_us = 0 if last is None else last.timestamp_us + step_ns // 1_000
        index = self.index if last is None else last.index + 1
        frame = replace(measured(index, motion_of(level_mm)), received_ns=received_ns, timestamp_us=captured_us)
        return replace(frame, measured_ns=received_ns, queue_empty_ns=received_ns)

    def _frame(self, step_ns: int, age_ns: int, level_mm: float) -> None:
        self._tell_frame(self._next(step_ns, level_mm), age_ns, level_mm=level_mm)

    def _tell_frame(self, frame: Measurement, age_ns: int, *, level_mm: float | None, **kind: bool) -> None:
        self.now_ns = max(self.now_ns, frame.received_ns + age_ns)
        was_on = self.oracle.is_on
        self._tell(frame)
        self.oracle.frame(
            received_ns=frame.received_ns,
            captured_ns=frame.timestamp_us * 1_000,
            now_ns=self.now_ns,
            level_mm=level_mm,
            **kind,
        )
        self.times_on += self.oracle.is_on and not was_on
        self.the_gate_is_where_a_plain_reading_of_the_rules_says()

    def _tell(self, happened: object) -> None:
        self.gate = step_gate(self.gate, happened, self.now_ns, self.limits)


PATIENT = settings(
    max_examples=150, stateful_step_count=25, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)


def test_the_gate_is_always_where_a_plain_reading_of_its_rules_states_and_most_histories_reach_the_beam():
    class Counted(GateMachine):
        reached: ClassVar[Counter[str]] = Counter()

    run_state_machine_as_test(Counted, settings=PATIENT)
    histories = Counted.reached["histories"]
    assert Counted.reached["on"] >= 0.8 * histories
    assert Counted.reached["on again"] >= 0.3 * histories


@pytest.mark.parametrize("reason", list(HoldReason))
def test_what_latches_is_what_the_plain_reading_of_the_rules_names_and_nothing_else(reason):
    stream = stream_in(GateState.BEAM_ON)
    is_fault = str(reason) in LATCHING
    assert stream.step(Interruption(reason)).state is (GateState.FAULT if is_fault else GateState.HOLD)
    assert stream.good(6)[-1] is (GateState.FAULT if is_fault else GateState.BEAM_ON)


def test_every_word_that_latches_is_a_reason():
    assert {str(reason) for reason in HoldReason} >= LATCHING
