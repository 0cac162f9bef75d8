"""The real engine between its source and its line as a state machine, on a clock that only the test moves.

Whatever happens, in any order: what the keeper, the driver and the line make of it is held against the same plain
reading of the rules as the gate alone (`tests.support.gating.gate_oracle`). A line that lies, falls silent or refuses
is part of it,
as are a watchdog that fires and people who hold by hand.
"""

from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
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

from engine.control.turn_inputs import Command
from engine.core.commands import Acknowledge, Arm, Disarm, HoldBeam, ReleaseBeam, SetReference
from engine.core.errors import BeamLineError, TidegateError
from engine.core.frames import LostReason, Measurement, MeasurementState
from engine.core.gate_state import HoldReason, Lease
from tests.support.control.loop_bench import Bench, ScriptedSource, WatchedBeamLine, drained, silent
from tests.support.gating.gate_oracle import LATCHING, MS, Oracle, Rules
from tests.support.gating.streams import LEVEL_MM, LIMITS, motion_of, unmeasured

pytestmark = pytest.mark.slow

PATIENT_LIMITS = replace(LIMITS, max_jump_mm=20.0, max_lag_ms=500.0, max_latency_ms=1_000.0, min_fps=6.0)
RULES = Rules()
SECOND_NS = 1_000 * MS
FAULTS = [HoldReason(word) for word in sorted(LATCHING)]
LATEST_ARMING_NS = 120 * MS
"""A frame that is older is none to arm on: a gap and a frame's age."""
STEPS_NS = st.integers(20 * MS, 50 * MS)


class TroubledLine(WatchedBeamLine):
    """Does as requested, and says of itself what the test wants: the truth, a lie, or nothing."""

    answer = "true"
    refuses = False

    def permit(self, lease: Lease) -> None:
        if self.refuses:
            raise BeamLineError("refused")
        super().permit(lease)

    def is_on(self) -> bool:
        if self.answer == "none":
            raise BeamLineError("no answer")
        return self.is_really_on() if self.answer == "true" else not self.is_really_on()

    def is_really_on(self) -> bool:
        return super().is_on()


class LoopMachine(RuleBasedStateMachine):
    """One session of one engine, stepped by hand: no thread runs."""

    reached: ClassVar[Counter[str]] = Counter()

    def __init__(self) -> None:
        super().__init__()
        self.bench = Bench([], limits=PATIENT_LIMITS, beam=TroubledLine)
        self.loop, self.line, self.clock = self.bench.loop, self.bench.beam, self.bench.clock
        self.oracle, self.model = Oracle(rules=RULES), self.bench.pipeline.model
        self.is_held_by_hand = False
        self.times_on = 0
        self.received_ns: list[int] = []
        self.loop._open()

    @initialize(frames=st.integers(5, 9))
    def begin(self, frames: int) -> None:
        self._good(33 * MS)
        self.arm()
        for _ in range(frames):
            self._good(33 * MS)

    # Frames.

    @rule(steps_ns=st.lists(STEPS_NS, min_size=1, max_size=8))
    def good_frames(self, steps_ns: list[int]) -> None:
        for step_ns in steps_ns:
            self._good(step_ns)

    @rule(times=st.integers(1, 3))
    def frames_that_come_too_seldom(self, times: int) -> None:
        """Three good ones then make a dwell, but no rate."""
        for step_ns in [490 * MS] * times + [50 * MS] * 3:
            self._good(step_ns)

    @rule(step_ns=STEPS_NS, level_mm=st.sampled_from([3.01, -1.01, 6.0]))
    def a_frame_outside(self, step_ns: int, level_mm: float) -> None:
        self._frame(step_ns, lambda frame: replace(frame, motion=motion_of(level_mm)), level_mm=level_mm)

    @rule(step_ns=STEPS_NS, lost=st.sampled_from([LostReason.MARKER_LOST, LostReason.COVERAGE_LOW]))
    def a_frame_that_shows_no_patient(self, step_ns: int, lost: LostReason) -> None:
        self._frame(
            step_ns,
            lambda frame: unmeasured(frame, MeasurementState.LOST, lost),
            level_mm=None,
            shows_patient=False,
        )

    @rule(step_ns=STEPS_NS)
    def a_frame_that_cannot_be(self, step_ns: int) -> None:
        nan = motion_of(float("nan"))
        self._frame(
            step_ns,
            lambda frame: replace(frame, motion=nan),
            level_mm=None,
            is_nonsense=True,
            shows_patient=False,
        )

    @rule(step_ns=STEPS_NS)
    def a_measurement_of_another_frame(self, step_ns: int) -> None:
        """The gate would take it for one that came a moment earlier; the loop knows better."""
        self._frame(
            step_ns, lambda frame: replace(frame, measured_ns=0, timestamp_us=frame.timestamp_us - 1), faults=True
        )

    @rule(step_ns=STEPS_NS, late_ms=st.sampled_from([56, 75, 80, 200, 600]))
    def a_measuring_that_dawdles(self, step_ns: int, late_ms: int) -> None:
        def dawdle(frame: Measurement) -> Measurement:
            self.clock.advance_ns(late_ms * MS)
            return frame

        self._frame(step_ns, dawdle)

    @rule(times=st.integers(1, 10))
    def silence(self, times: int) -> None:
        for _ in range(times):
            self.bench.source.script.append(silent)
            self._run(lambda: self.oracle.silence(self.clock.now_ns()))

    # People.

    @rule()
    def arm(self) -> None:
        is_refused = self.oracle.refuses_arming(self.clock.now_ns())
        is_armed = self._ask(Arm(operator="ann"), self.oracle.arm, is_refused=is_refused)
        assert is_armed is (self.oracle.is_armed and not is_refused), "a line in trouble makes a fault of it"

    @rule(left_ns=st.sampled_from([-1, 0, 1, 5 * MS, 60 * MS]))
    def arm_on_an_old_frame(self, left_ns: int) -> None:
        """At about the last moment at which the newest frame still counts; a gate that is armed says no by itself."""
        self._see_to_everything()
        self.disarm()
        self.clock.advance_ns(self.oracle.last[0] + LATEST_ARMING_NS - left_ns - self.clock.now_ns())
        self.arm()

    @rule(without=st.sampled_from(["model", "zero", "cycles"]), is_disarmed=st.booleans(), shows_patient=st.booleans())
    def something_lacks_for_a_moment(self, without: str, is_disarmed: bool, shows_patient: bool) -> None:
        """And somebody arms all the same."""
        self._see_to_everything()
        if is_disarmed:
            self.disarm()
        elif not self.oracle.is_armed:
            self.arm()
        self._lack(without)
        self.arm()
        if shows_patient:
            self._good(33 * MS)
        else:
            self.a_frame_that_shows_no_patient(33 * MS, LostReason.MARKER_LOST)
        self.arm()
        self._lack(None)
        self.arm()

    def _lack(self, without: str | None) -> None:
        pipeline = self.bench.pipeline
        pipeline.model = None if without == "model" else self.model
        pipeline.has_reference = without != "zero"
        pipeline.model_shortcoming = "two cycles only" if without == "cycles" else None
        self.oracle.has_model, self.oracle.has_zero = without not in {"model", "cycles"}, without != "zero"

    @rule()
    def disarm(self) -> None:
        """By the one who may hold by hand: that hold ends with it."""
        self.is_held_by_hand = False
        assert self._ask(Disarm(operator="bob"), self.oracle.disarm)

    @rule()
    def another_person_disarms(self) -> None:
        assert self._ask(Disarm(operator="ann"), self.oracle.disarm)

    @rule()
    def acknowledge(self) -> None:
        self._ask(Acknowledge(operator="ann"), self.oracle.acknowledge, is_refused=not self.oracle.is_faulted)

    @rule()
    def set_the_reference(self) -> None:
        is_refused = self.oracle.refuses_reference()
        self._ask(SetReference(operator="ann", reason="as it is"), self.oracle.disarm, is_refused=is_refused)

    @rule()
    def hold_by_hand(self) -> None:
        self.is_held_by_hand = True
        assert self._ask(HoldBeam(operator="bob"), self.oracle.hold)

    @rule()
    def release(self) -> None:
        was_held, self.is_held_by_hand = self.is_held_by_hand, False
        self._ask(ReleaseBeam(operator="bob"), self.oracle.hold, is_refused=not was_held)

    @precondition(lambda self: not self.oracle.is_armed)
    @rule(frames=st.integers(4, 8))
    def see_to_everything_arm_and_wait(self, frames: int) -> None:
        """As a person does who wants the beam back."""
        self._see_to_everything()
        self.arm()
        for _ in range(frames):
            self._good(33 * MS)

    def _see_to_everything(self) -> None:
        self.line.answer, self.line.refuses = "true", False
        if self.is_held_by_hand:
            self.release()
        self._good(33 * MS)
        if self.oracle.is_faulted:
            self.acknowledge()
        self._good(33 * MS)

    # The line, the watchdog, and others who report.

    @rule(answer=st.sampled_from(["true", "lie", "none"]), refuses=st.booleans())
    def the_line_changes_its_mind(self, answer: str, refuses: bool) -> None:
        self.line.answer, self.line.refuses = answer, refuses

    @rule(answer=st.sampled_from(["true", "lie", "none"]))
    def the_line_fails_while_it_is_on(self, answer: str) -> None:
        """A line that says the truth refuses the next permit."""
        self._see_to_everything()
        if not self.oracle.is_armed:
            self.arm()
        for _ in range(5):
            self._good(33 * MS)
        self.line.answer, self.line.refuses = answer, answer == "true"
        self._good(33 * MS)

    @rule(reason=st.sampled_from(FAULTS))
    def somebody_reports_a_fault(self, reason: HoldReason) -> None:
        self.loop.report_fault(reason, "as the test wants it")
        self._good(33 * MS, before=lambda: self.oracle.fault(self.clock.now_ns()))

    @rule(late_ns=st.sampled_from([0, 1, 50 * MS]))
    def the_engine_hangs(self, late_ns: int) -> None:
        """The watchdog looks; it fires where an armed gate's newest decision is older than its deadline."""
        self.clock.advance_ns(200 * MS + late_ns)
        is_fired = self.bench.watchdog.check(self.clock.now_ns())
        assert not (is_fired and self.line.is_really_on())
        if is_fired:
            self._good(20 * MS, before=lambda: self.oracle.fault(self.clock.now_ns()))

    @rule(gone_ns=st.integers(1 * MS, 400 * MS))
    def time_passes(self, gone_ns: int) -> None:
        self.clock.advance_ns(gone_ns)

    # What must be so after every step.

    @invariant()
    def the_gate_is_where_a_plain_reading_of_the_rules_says(self) -> None:
        assert str(self.loop.gate.state) == self.oracle.state

    @invariant()
    def the_line_is_on_only_where_the_rules_allow_it_and_within_the_newest_frame_s_lease(self) -> None:
        if self.line.is_really_on():
            assert self.oracle.is_on
            assert self.clock.now_ns() < self.oracle.last[0] + RULES.lease_ns

    @invariant()
    def a_fault_has_latched_the_line_too(self) -> None:
        if self.oracle.is_faulted:
            now_ns = self.clock.now_ns()
            grantable = Lease(granted_ns=now_ns + 1, expires_ns=now_ns + 80 * MS, sequence=10**9)
            try:
                WatchedBeamLine.permit(self.line, grantable)
            except BeamLineError:
                return
            raise AssertionError("a permit was taken though a fault is latched")

    def teardown(self) -> None:
        event(f"on {min(self.times_on, 3)} times")
        target(float(min(self.times_on, 10)))
        self.reached["histories"] += 1
        self.reached["on"] += self.times_on > 0
        self.reached["on again"] += self.times_on > 1
        self.loop._commands.close("the test is over")

    # How facts reach the engine.

    def _good(self, step_ns: int, before=lambda: None) -> None:
        self._frame(step_ns, lambda frame: replace(frame, motion=motion_of(LEVEL_MM)), before=before)

    def _frame(
        self,
        step_ns: int,
        spoil,
        *,
        level_mm: float | None = LEVEL_MM,
        is_nonsense: bool = False,
        faults: bool = False,
        shows_patient: bool = True,
        before=lambda: None,
    ) -> None:
        """Deliver a frame ``step_ns`` later; tell the oracle of it as of when it was decided on."""
        source = self.bench.source
        index = source.frames
        received_ns = 0

        def deliver(source: ScriptedSource, _timeout_s: float):
            nonlocal received_ns
            source.clock.advance_ns(step_ns)
            received_ns = source.clock.now_ns()
            return source.frame()

        self.bench.pipeline.spoil[index] = spoil
        source.script.append(deliver)

        def happened() -> None:
            now_ns = self.clock.now_ns()
            before()
            if faults:
                self.oracle.fault(now_ns)
            self.oracle.frame(
                received_ns=received_ns,
                captured_ns=received_ns // 1_000 * 1_000,
                now_ns=now_ns,
                level_mm=None if self._is_forbidden(received_ns) else level_mm,
                is_nonsense=is_nonsense,
            )
            self.oracle.shows_patient = shows_patient

        self._run(happened)

    def _is_forbidden(self, received_ns: int) -> bool:
        """A hand on the beam, no model or zero, or fewer than six frames within the last second."""
        self.received_ns.append(received_ns)
        recent = [at_ns for at_ns in self.received_ns if received_ns - at_ns < SECOND_NS]
        is_slow = received_ns - self.received_ns[0] >= SECOND_NS and len(recent) < PATIENT_LIMITS.min_fps
        pipeline = self.bench.pipeline
        return self.is_held_by_hand or is_slow or pipeline.model is None or not pipeline.has_reference

    def _run(self, happened) -> None:
        was_on = self.oracle.is_on
        self.loop._session.run(self.loop._reader.turn().commands, self.loop._opened_ns)
        happened()
        self._stand()
        self.times_on += self.oracle.is_on and not was_on
        self._look()

    def _ask(self, command: Command, happens: Callable[[int], None], *, is_refused: bool = False) -> bool:
        """Ask between two frames; what the rules refuse must touch nothing. Return whether it was carried out."""
        before, line_before = self.loop.gate, self.line.is_really_on()
        answer: Future[None] = self.loop.submit(command)
        for letter in self.loop._commands.take():
            self.loop._session._answer(letter)
        error = answer.exception(timeout=0)
        assert error is None or isinstance(error, TidegateError)
        if is_refused:
            assert error is not None
            assert _decided(self.loop.gate) == _decided(before)
            assert self.line.is_really_on() is line_before
        else:
            happens(self.clock.now_ns())
            self._stand()
        self._look()
        return error is None

    def _stand(self) -> None:
        """What stands against the beam after a decision: a hand, and a line that does not do as requested."""
        now_ns = self.clock.now_ns()
        if self.is_held_by_hand:
            self.oracle.hold(now_ns)
        wanted_on = self.oracle.is_on
        is_trouble = self.line.answer != "true" or (wanted_on and self.line.refuses)
        if is_trouble:
            self.oracle.fault(now_ns)

    def _look(self) -> None:
        drained(self.loop.samples)
        drained(self.loop.transitions)
        self.the_gate_is_where_a_plain_reading_of_the_rules_says()


def _decided(gate):
    """The gate without where its signals were: a new reference moves their scale with whatever comes next."""
    return replace(gate, conditions=tuple(replace(one, trail=None) for one in gate.conditions))


PATIENT = settings(
    max_examples=200, stateful_step_count=20, deadline=None, suppress_health_check=[HealthCheck.too_slow]
)


def test_the_engine_s_line_is_on_only_where_a_plain_reading_of_the_rules_allows_it_and_most_histories_reach_the_beam():
    class Counted(LoopMachine):
        reached: ClassVar[Counter[str]] = Counter()

    run_state_machine_as_test(Counted, settings=PATIENT)
    histories = Counted.reached["histories"]
    assert Counted.reached["on"] >= 0.8 * histories
    assert Counted.reached["on again"] >= 0.3 * histories
