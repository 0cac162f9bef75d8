"""The loop believes only what the line reads back, and a hold that came meanwhile always wins."""

from dataclasses import replace

import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.core.clock import ManualClock
from engine.core.commands import Acknowledge
from engine.core.errors import BeamLineError, BeamLineMismatchError
from engine.core.gate_state import GateState, HoldReason
from tests.support.control.armed_bench import ARM, ON_AT, armed_bench
from tests.support.control.loop_bench import WatchedBeamLine, after, driver_of, good
from tests.support.gating.streams import LIMITS, MS, stream_in


class Refusing(WatchedBeamLine):
    """Refuses its third permit."""

    def permit(self, lease):
        if lease.sequence == 3:
            raise BeamLineError("no")
        super().permit(lease)


class Deaf(WatchedBeamLine):
    """Takes the third permit, and stays off."""

    def permit(self, lease):
        if lease.sequence == 3:
            self.hold(HoldReason.DWELL)
            return
        super().permit(lease)


class Mute(WatchedBeamLine):
    """Does not answer after the third permit."""

    is_mute = False

    def permit(self, lease):
        super().permit(lease)
        self.is_mute |= lease.sequence == 3

    def is_on(self):
        if self.is_mute:
            raise BeamLineError("no answer")
        return super().is_on()


class Contrary(WatchedBeamLine):
    """Says of itself, after the third permit, that it reads back otherwise than commanded."""

    def is_on(self):
        if self.permits and self.permits[-1].sequence == 3:
            raise BeamLineMismatchError("off for 160 ms though commanded on")
        return super().is_on()


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (Refusing, HoldReason.BEAM_LINE_FAILED),
        (Deaf, HoldReason.BEAM_LINE_MISMATCH),
        (Mute, HoldReason.BEAM_LINE_FAILED),
        (Contrary, HoldReason.BEAM_LINE_MISMATCH),
    ],
)
def test_a_line_that_does_not_follow_its_command_is_held_and_faults(line, reason):
    bench = armed_bench([good] * 10, beam=line).run()
    records = bench.records()
    assert [record.line_on for record in records[ON_AT : ON_AT + 2]] == [True, True]
    assert {record.gate_state for record in records[ON_AT + 2 :]} == {GateState.FAULT}
    assert records[ON_AT + 2].hold_reason is reason
    assert len([lease for lease in bench.beam.permits if lease.sequence > 3]) == 0
    assert not SimulatedBeamLine.is_on(bench.beam)


def test_a_line_that_does_not_answer_is_reported_as_perhaps_on():
    bench = armed_bench([good] * 10, beam=Mute).run()
    assert bench.records()[ON_AT + 3].line_on


class Stuck(WatchedBeamLine):
    """Reads back as on, whatever is commanded, once it was."""

    was_on = False

    def is_on(self):
        self.was_on |= super().is_on()
        return self.was_on


def test_a_line_that_stays_on_though_held_faults():
    bench = armed_bench([good] * 10, beam=Stuck)
    bench.pipeline.spoil[ON_AT + 1] = _outside
    records = bench.run().records()
    assert (records[ON_AT + 1].gate_state, records[ON_AT + 1].hold_reason) == (
        GateState.FAULT,
        HoldReason.BEAM_LINE_MISMATCH,
    )
    assert records[ON_AT + 1].line_on


class Slow(WatchedBeamLine):
    """Reads back what it was sent only after two more readings, and says meanwhile that it settles."""

    def __init__(self, clock):
        super().__init__(clock)
        self.shown, self.left = False, 0

    @property
    def is_settling(self):
        return self.left > 0

    def permit(self, lease):
        super().permit(lease)
        self._tell(is_on=True)

    def hold(self, reason):
        super().hold(reason)
        self._tell(is_on=False)

    def _tell(self, *, is_on):
        if is_on is self.shown:
            return
        self.left = self.left - 1 if self.left else 2
        if not self.left:
            self.shown = is_on

    def is_on(self):
        return self.shown


def test_a_line_that_settles_is_no_trouble_and_counts_as_not_yet_on_and_then_as_still_on():
    bench = armed_bench([good] * 10, beam=Slow)
    bench.pipeline.spoil[ON_AT + 4] = _outside
    records = bench.run().records()
    assert [record.line_on for record in records[ON_AT : ON_AT + 7]] == [False, False, True, True, True, True, False]
    assert [str(record.gate_state) for record in records[ON_AT : ON_AT + 5]] == ["beam_on"] * 4 + ["hold"]
    assert GateState.FAULT not in {record.gate_state for record in records}


class TurningOver(WatchedBeamLine):
    """Its own thread finds out between two questions that the line may be on: it settles by the second."""

    asked = 0

    @property
    def is_settling(self):
        self.asked += 1
        return self.asked % 2 == 0

    def is_on(self):
        return not super().is_on()


def test_a_line_that_begins_to_settle_between_two_questions_is_no_trouble():
    clock = ManualClock(0)
    line = TurningOver(clock)
    report = driver_of(line, clock).carry_out(stream_in(GateState.HOLD).gate, 0)
    assert (report.is_on, report.is_settling, report.trouble) == (True, True, None)


def _outside(frame):
    from tests.support.gating.streams import motion_of

    return replace(frame, motion=motion_of(3.2))


def test_the_watchdog_wins_against_a_permit_that_was_decided_before_it_held():
    bench = armed_bench([good] * 10)

    def interfere(lease):
        if lease.sequence == 3:
            bench.watchdog._armed_since_ns = 0
            assert bench.watchdog.check(bench.clock.now_ns())

    bench.beam.before_permit = interfere
    records = bench.run().records()
    assert [record.line_on for record in records[ON_AT : ON_AT + 3]] == [True, True, False]
    assert (records[ON_AT + 2].gate_state, records[ON_AT + 2].hold_reason) == (GateState.FAULT, HoldReason.WATCHDOG)
    assert [change.to_state for change in bench.transitions()].count(GateState.FAULT) == 1
    assert len(bench.beam.permits) == 2


def test_a_decision_that_outlived_its_lease_is_not_carried_out():
    bench = armed_bench([good] * 12)
    clock, waits = bench.clock, iter([0, 0, 80])

    def dawdle(_lease):
        clock.advance_ns(next(waits, 0) * MS)

    bench.beam.before_permit = dawdle
    records = bench.run().records()
    late = records[ON_AT + 2]
    assert (late.gate_state, late.hold_reason, late.line_on) == (GateState.HOLD, HoldReason.FRAME_LATE, False)
    assert len(bench.beam.edges) >= 2
    assert bench.beam.edges[1].is_on is False


def test_after_a_command_sent_too_late_the_line_is_held_by_the_decision_that_finds_it_out():
    """The lease would still run, and the next frame is a period away."""
    limits = replace(LIMITS, max_latency_ms=100.0, camera_latency_ms=60.0)
    bench = armed_bench([good] * 6, limits=limits)

    def dawdle(lease):
        if lease.sequence == 3:
            bench.clock.advance_ns(40 * MS)

    bench.beam.before_permit = dawdle
    late = bench.run().records()[ON_AT + 2]
    assert (late.gate_state, late.hold_reason, late.line_on) == (GateState.FAULT, HoldReason.LATENCY_HIGH, False)
    off = bench.beam.edges[1]
    assert (off.at_ns, off.is_on, off.reason) == (late.asserted_ns, False, HoldReason.LATENCY_HIGH)
    assert off.at_ns < late.received_ns + 80 * MS
    assert bench.beam._deadman._is_latched


def test_a_permit_that_was_sent_too_late_is_on_record_before_the_fault_that_took_it_back():
    limits = replace(LIMITS, max_latency_ms=100.0, camera_latency_ms=60.0)
    bench = armed_bench([good] * 6, limits=limits)

    def dawdle(lease):
        if lease.sequence == 1:
            bench.clock.advance_ns(40 * MS)

    bench.beam.before_permit = dawdle
    bench.run()
    edges = [edge.is_on for edge in bench.beam.edges]
    assert edges == [True, False]
    path = [(change.from_state, change.to_state, change.reason) for change in bench.transitions()]
    assert (GateState.DWELL, GateState.BEAM_ON, None) in path
    at = path.index((GateState.DWELL, GateState.BEAM_ON, None))
    assert path[at + 1] == (GateState.BEAM_ON, GateState.FAULT, HoldReason.LATENCY_HIGH)


def test_a_line_is_not_even_asked_once_the_lease_it_would_get_has_ended():
    class Gullible(WatchedBeamLine):
        def permit(self, lease):
            self.permits.append(lease)

    clock = ManualClock(0)
    line = Gullible(clock)
    gate = stream_in(GateState.BEAM_ON).gate
    clock.advance_ns(gate.last.received_ns + 80 * MS)
    report = driver_of(line, clock).carry_out(gate, clock.now_ns())
    assert (report.is_on, report.trouble.reason) == (False, HoldReason.FRAME_LATE)
    assert line.permits == []


def test_a_line_that_cannot_be_read_after_a_hold_is_latched():
    class Unread(WatchedBeamLine):
        def is_on(self):
            raise BeamLineError("no answer")

    clock = ManualClock(0)
    line = Unread(clock)
    line.open()
    line.rearm()
    report = driver_of(line, clock).carry_out(stream_in(GateState.HOLD).gate, 0)
    assert (report.is_on, report.trouble.reason) == (True, HoldReason.BEAM_LINE_FAILED)
    assert line._deadman._is_latched


def test_a_watchdog_that_fires_again_after_an_acknowledgement_is_recorded_again():
    """One thread records each firing; an acknowledgement makes the next one a new one."""
    bench = armed_bench([good] * 6)
    bench.source.script += [after(bench.ask(Acknowledge(operator="anna"))), good, after(bench.ask(ARM)), *[good] * 6]
    fired_at = []

    def fire(lease):
        if not bench.watchdog.has_fired and len(fired_at) < 2 and lease.sequence >= 3 + 2 * len(fired_at):
            fired_at.append(lease.sequence)
            bench.watchdog._armed_since_ns = 0
            assert bench.watchdog.check(bench.clock.now_ns())

    bench.beam.before_permit = fire
    bench.run()
    faults = [change for change in bench.transitions() if change.to_state is GateState.FAULT]
    assert len(fired_at) == 2
    assert [fault.reason for fault in faults] == [HoldReason.WATCHDOG] * 2
