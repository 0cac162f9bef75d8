"""The accelerator's beam-on signal against the permit, in both directions."""

import queue

import pytest

from engine.beam.beam_on import (
    ABSENT_BOUNDS_S,
    AFTER_PERMIT_BOUNDS_MS,
    KEPT_OFFS,
    BeamOff,
    BeamOnComparison,
    Permission,
)
from engine.beam.compared_line import REPORT_NS, ComparedBeamLine
from engine.beam.simulated import SimulatedAccelerator, SimulatedBeamLine
from engine.core.clock import ManualClock, MonotonicClock
from engine.core.errors import BeamLineError, InvalidValueError
from engine.core.gate_state import HoldReason, Lease

MS = 1_000_000
BOUND_MS = 100.0
ABSENT_MS = 2_000
WITHOUT = HoldReason.BEAM_WITHOUT_PERMIT


class Unthreaded(ComparedBeamLine):
    """Its thread is the test's loop."""

    def _start_thread(self):
        """None: the test compares."""


class Room:
    """A simulated line and accelerator, compared every 10 ms of a clock that only the test moves."""

    def __init__(self, *, delay_ms=30.0, bound_ms=BOUND_MS):
        self.clock = ManualClock(5_000 * MS)
        self.inner = SimulatedBeamLine(self.clock)
        self.accelerator = SimulatedAccelerator(self.inner, self.clock, delay_ms=delay_ms)
        read = self.accelerator.read
        self.line = Unthreaded(self.inner, self.clock, read, after_permit_ms=bound_ms, absent_s=ABSENT_MS / 1000)
        self.faults = []
        self.line.on_trouble = lambda reason, detail: self.faults.append((reason, detail, self.clock.now_ns()))
        self.line.open()
        self.line.rearm()
        self.sequence = 0

    def permit(self, length_ms=80):
        now_ns = self.clock.now_ns()
        self.sequence += 1
        self.line.permit(Lease(granted_ns=now_ns, expires_ns=now_ns + length_ms * MS, sequence=self.sequence))

    def pass_ms(self, length_ms, *, permits=False, holds=None):
        """Go on by tens of milliseconds, permitting or holding at each, as a session does at each frame."""
        for _ in range(length_ms // 10):
            if permits:
                self.permit()
            if holds is not None:
                self.line.hold(holds)
            self.clock.advance_ns(10 * MS)
            self.line.compare_once()


def test_a_beam_that_follows_the_permit_is_no_fault_and_its_end_is_measured():
    room = Room(delay_ms=30.0)
    room.pass_ms(300, permits=True)
    assert room.line.state.is_on
    held_ns = room.clock.now_ns()
    room.line.hold(HoldReason.OUTSIDE_WINDOW)
    room.pass_ms(200)
    state = room.line.state
    assert (state.is_on, state.offs, room.faults) == (False, 1, [])
    assert state.last_off_ms == pytest.approx(40.0, abs=10.1)
    assert room.clock.now_ns() > held_ns


@pytest.mark.parametrize(("delay_ms", "is_fault"), [(80.0, False), (140.0, True)])
def test_the_beam_may_last_as_long_after_the_permit_as_the_site_allows(delay_ms, is_fault):
    room = Room(delay_ms=delay_ms)
    room.pass_ms(300, permits=True)
    room.line.hold(HoldReason.OUTSIDE_WINDOW)
    room.pass_ms(400)
    assert bool(room.faults) is is_fault
    assert room.line.state.offs == 1
    assert room.line.state.last_off_ms == pytest.approx(delay_ms + 10.0, abs=10.1)


def test_holds_at_every_frame_do_not_start_the_beam_s_time_anew():
    room = Room()
    room.pass_ms(300, permits=True)
    room.accelerator.stuck = True
    held_ns = room.clock.now_ns()
    room.pass_ms(300, holds=HoldReason.OUTSIDE_WINDOW)
    reason, detail, at_ns = room.faults[0]
    assert reason is WITHOUT
    assert BOUND_MS * MS < at_ns - held_ns <= BOUND_MS * MS + 10 * MS
    assert detail == "the accelerator reports beam on 110 ms after the permit ended: at most 100 ms are allowed"


def test_the_time_counts_from_the_end_of_a_lease_that_no_one_renewed_or_held():
    room = Room()
    room.pass_ms(300, permits=True)
    room.accelerator.stuck = True
    ended_ns = room.clock.now_ns() - 10 * MS + 80 * MS
    room.pass_ms(400)
    assert BOUND_MS * MS < room.faults[0][2] - ended_ns <= BOUND_MS * MS + 10 * MS


def test_a_beam_that_was_never_permitted_is_a_fault_at_once_and_latches_the_line():
    room = Room()
    room.accelerator.stuck = True
    room.pass_ms(10)
    assert [fault[:2] for fault in room.faults] == [
        (WITHOUT, "the accelerator reports beam on, and nothing was permitted")
    ]
    room.accelerator.stuck = None
    with pytest.raises(BeamLineError, match="latched"):
        room.permit()
    room.pass_ms(10)
    room.line.rearm()
    room.permit()
    assert room.inner.is_on()


def test_a_beam_that_comes_long_after_a_hold_is_a_fault_at_its_first_reading():
    room = Room()
    room.pass_ms(300, permits=True)
    room.line.hold(HoldReason.OUTSIDE_WINDOW)
    room.pass_ms(1_000)
    assert room.faults == []
    room.accelerator.stuck = True
    room.pass_ms(10)
    assert len(room.faults) == 1


def test_while_it_lasts_it_is_reported_again_and_the_line_is_not_armed():
    room = Room()
    room.accelerator.stuck = True
    room.pass_ms(900)
    assert len(room.faults) == 1_000 * MS // REPORT_NS
    assert len({detail for _, detail, _ in room.faults}) == 1
    with pytest.raises(BeamLineError, match="reports beam on, and nothing was permitted"):
        room.line.rearm()
    room.accelerator.stuck = False
    room.pass_ms(10)
    room.line.rearm()
    room.accelerator.stuck = True
    room.pass_ms(10)
    assert len(room.faults) == 1 + 1_000 * MS // REPORT_NS


def test_a_permit_without_a_beam_is_reported_and_holds_nothing():
    room = Room()
    room.accelerator.stuck = False
    room.pass_ms(ABSENT_MS - 20, permits=True)
    assert not room.line.state.is_absent
    room.pass_ms(30, permits=True)
    assert (room.line.state.is_absent, room.line.state.absences, room.faults) == (True, 1, [])
    assert room.inner.is_on()
    room.accelerator.stuck = True
    room.pass_ms(50, permits=True)
    assert not room.line.state.is_absent
    room.accelerator.stuck = False
    room.pass_ms(ABSENT_MS + 100, permits=True)
    assert (room.line.state.is_absent, room.line.state.absences) == (True, 2)


def test_permitted_time_without_a_beam_is_added_up_over_permits_and_held_time_does_not_count():
    room = Room()
    room.accelerator.stuck = False
    for _ in range(3):
        room.pass_ms(ABSENT_MS // 4, permits=True)
        room.line.hold(HoldReason.OUTSIDE_WINDOW)
        room.pass_ms(3 * ABSENT_MS)
    assert not room.line.state.is_absent
    room.pass_ms(ABSENT_MS // 4 + 50, permits=True)
    assert (room.line.state.is_absent, room.line.state.absences) == (True, 1)
    room.line.hold(HoldReason.OUTSIDE_WINDOW)
    room.pass_ms(1_000)
    assert room.line.state.is_absent, "it stays so between two permits"
    room.permit()
    room.pass_ms(100, permits=True)
    assert room.line.state.absences == 1


def test_one_reading_of_a_beam_or_an_arming_begins_the_time_without_one_anew():
    room = Room()
    for restart in (lambda: setattr(room.accelerator, "stuck", True), room.line.rearm):
        room.accelerator.stuck = False
        room.pass_ms(ABSENT_MS - 50, permits=True)
        restart()
        room.pass_ms(10, permits=True)
        room.accelerator.stuck = False
        room.pass_ms(ABSENT_MS - 100, permits=True)
        assert not room.line.state.is_absent
        room.line.rearm()
        room.pass_ms(10)
    room.pass_ms(ABSENT_MS + 50, permits=True)
    assert room.line.state.is_absent
    room.line.rearm()
    room.pass_ms(10, permits=True)
    assert not room.line.state.is_absent


def test_a_late_reading_counts_from_the_begin_of_the_permit_and_not_from_the_reading_before():
    comparison = BeamOnComparison(absent_s=1.0)
    comparison.compare(Permission(ended_ns=0), is_on=False, now_ns=MS)
    comparison.compare(Permission(since_ns=9_500 * MS), is_on=False, now_ns=10_000 * MS)
    assert not comparison.state.is_absent
    comparison.compare(Permission(since_ns=9_500 * MS), is_on=False, now_ns=10_500 * MS)
    assert comparison.state.is_absent


def test_time_in_which_the_signal_is_not_known_is_no_time_without_a_beam():
    comparison = BeamOnComparison(absent_s=1.0)
    comparison.compare(Permission(since_ns=0), is_on=False, now_ns=0)
    for step in range(1, 1_000):
        comparison.compare(Permission(since_ns=0), is_on=None, now_ns=step * 10 * MS)
    comparison.compare(Permission(since_ns=0), is_on=False, now_ns=10_000 * MS)
    assert not comparison.state.is_absent


def test_a_held_line_without_a_beam_is_not_missing_one():
    room = Room()
    room.pass_ms(3_000, holds=HoldReason.OUTSIDE_WINDOW)
    assert (room.line.state.is_absent, room.line.state.absences, room.faults) == (False, 0, [])


def test_the_slowest_hold_and_the_last_are_kept():
    comparison = BeamOnComparison(after_permit_ms=BOUND_MS)
    for off_ms in (40, 70, 20):
        comparison.compare(Permission(since_ns=0), is_on=True, now_ns=1_000 * MS)
        comparison.compare(Permission(ended_ns=1_000 * MS), is_on=True, now_ns=1_010 * MS)
        comparison.compare(Permission(ended_ns=1_000 * MS), is_on=False, now_ns=(1_000 + off_ms) * MS)
        comparison.compare(Permission(ended_ns=1_000 * MS), is_on=False, now_ns=9_000 * MS)
    assert (comparison.state.last_off_ms, comparison.state.slowest_off_ms, comparison.state.offs) == (20.0, 70.0, 3)
    ended_ns = 1_000 * MS
    assert comparison.state.newest_offs == tuple(
        BeamOff(number=number, ended_ns=ended_ns, off_ms=off_ms) for number, off_ms in ((1, 40.0), (2, 70.0), (3, 20.0))
    )


def test_only_the_newest_holds_are_kept_and_their_numbers_go_on():
    room = Room()
    for _ in range(KEPT_OFFS + 3):
        room.pass_ms(200, permits=True)
        room.line.hold(HoldReason.OUTSIDE_WINDOW)
        room.pass_ms(200)
    numbers = [one.number for one in room.line.state.newest_offs]
    assert numbers == list(range(4, KEPT_OFFS + 4))


def test_a_hold_whose_beam_was_not_on_is_not_measured():
    room = Room()
    room.accelerator.stuck = False
    room.pass_ms(300, permits=True)
    room.line.hold(HoldReason.OUTSIDE_WINDOW)
    room.pass_ms(300)
    assert room.line.state.newest_offs == ()


def test_the_violation_is_part_of_the_state_while_it_lasts():
    room = Room()
    room.accelerator.stuck = True
    room.pass_ms(50)
    assert room.line.state.violation == "the accelerator reports beam on, and nothing was permitted"
    room.accelerator.stuck = False
    room.pass_ms(10)
    assert room.line.state.violation is None


def test_a_signal_that_is_not_known_is_no_beam_and_no_proof_of_none():
    comparison = BeamOnComparison(after_permit_ms=BOUND_MS)
    comparison.compare(Permission(ended_ns=0), is_on=None, now_ns=9_000 * MS)
    assert (comparison.state.is_on, comparison.violation) == (None, None)
    comparison.compare(Permission(ended_ns=0), is_on=True, now_ns=9_000 * MS)
    comparison.compare(Permission(ended_ns=0), is_on=None, now_ns=9_001 * MS)
    assert comparison.violation is not None
    comparison.compare(Permission(ended_ns=0), is_on=False, now_ns=9_002 * MS)
    assert comparison.violation is None


@pytest.mark.parametrize("bound_ms", [19.9, 1000.1, float("nan"), -1.0])
def test_the_bound_is_bounded_and_refused_by_name(bound_ms):
    with pytest.raises(InvalidValueError, match=r"^after_permit_ms .* 20 to 1000 ms"):
        BeamOnComparison(after_permit_ms=bound_ms)
    assert AFTER_PERMIT_BOUNDS_MS == (20.0, 1000.0)


@pytest.mark.parametrize("bound_s", [0.9, 120.1, float("nan")])
def test_the_bound_of_the_time_without_a_beam_is_refused_by_name(bound_s):
    with pytest.raises(InvalidValueError, match=r"^absent_s .* 1 to 120 s"):
        BeamOnComparison(absent_s=bound_s)
    assert ABSENT_BOUNDS_S == (1.0, 120.0)


def test_a_fault_of_the_line_itself_is_forwarded_and_ends_the_permit():
    room = Room()
    room.pass_ms(100, permits=True)
    room.inner.on_trouble(HoldReason.BEAM_LINE_FAILED, "cut")
    assert room.faults[0][:2] == (HoldReason.BEAM_LINE_FAILED, "cut")
    room.accelerator.stuck = True
    room.pass_ms(200)
    assert [fault[0] for fault in room.faults[1:]] == [WITHOUT]
    assert room.faults[1][2] - room.faults[0][2] <= BOUND_MS * MS + 10 * MS


def test_a_permit_that_is_renewed_between_two_readings_has_stood_since_it_was_first_given():
    room = Room()
    room.accelerator.stuck = False
    for _ in range(ABSENT_MS // 10):
        assert not room.line.state.is_absent
        room.permit()
        room.clock.advance_ns(6 * MS)
        room.permit()
        room.clock.advance_ns(4 * MS)
        room.line.compare_once()
    assert room.line.state.is_absent


def test_its_thread_compares_by_itself_and_ends_with_the_line():
    clock = MonotonicClock()
    line = ComparedBeamLine(SimulatedBeamLine(clock), clock, lambda: True)
    faults = queue.SimpleQueue()
    line.on_trouble = lambda reason, _detail: faults.put(reason)
    line.open()
    thread = line._thread
    assert (thread.name, thread.daemon) == ("tidegate-beam-on", True)
    assert faults.get(timeout=20.0) is WITHOUT
    line.close()
    assert not thread.is_alive()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_a_line_whose_comparing_thread_has_died_is_held_and_raises():
    clock = MonotonicClock()
    died = queue.SimpleQueue()

    def read():
        died.put(None)
        raise SystemExit

    line = ComparedBeamLine(SimulatedBeamLine(clock), clock, read)
    line.open()
    died.get(timeout=20.0)
    line._thread.join(20.0)
    with pytest.raises(BeamLineError, match="compares the beam-on signal has died"):
        line.is_on()
    line.close()


@pytest.mark.parametrize("delay_ms", [0.0, 50.0])
def test_a_simulated_accelerator_follows_its_line_after_its_delay_both_ways(delay_ms):
    room = Room(delay_ms=delay_ms, bound_ms=500.0)
    room.permit(length_ms=200)
    seen = []
    for _ in range(400):
        seen.append(room.accelerator.read())
        room.clock.advance_ns(MS)
    assert seen.index(True) == delay_ms
    assert seen.index(False, int(delay_ms)) == 200 + delay_ms if delay_ms else seen.index(False) == 200
