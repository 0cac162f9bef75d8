"""What the simulated line tells of itself: each edge, its time and its cause."""

import pytest

from engine.beam.simulated import BeamEdge, SimulatedBeamLine, SimulatedReceiver
from engine.core.clock import ManualClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease
from tests.support.beam.stepped_line import MS


@pytest.fixture
def clock():
    return ManualClock(0)


@pytest.fixture
def line(clock):
    held = SimulatedBeamLine(clock)
    held.open()
    held.rearm()
    return held


def permit(line, clock, sequence, *, granted_ms=None, until_ms=80):
    granted_ns = clock.now_ns() if granted_ms is None else granted_ms * MS
    line.permit(Lease(granted_ns=granted_ns, expires_ns=until_ms * MS, sequence=sequence))


def on(ms):
    return BeamEdge(at_ns=ms * MS, is_on=True)


def off(ms, reason=None):
    return BeamEdge(at_ns=ms * MS, is_on=False, reason=reason)


def test_a_permit_given_at_the_very_beginning_of_time_is_one(line, clock):
    permit(line, clock, 1)
    assert line.is_on()
    assert line.edges == (on(0),)


def test_a_renewed_lease_is_one_time_on_and_lapses_at_its_end(line, clock):
    permit(line, clock, 1, until_ms=80)
    clock.advance_ns(50 * MS)
    permit(line, clock, 2, until_ms=130)
    clock.advance_ns(79 * MS)
    assert line.edges == (on(0),)
    clock.advance_ns(MS)
    assert line.edges == (on(0), off(130))


def test_what_comes_at_the_very_end_of_a_lease_finds_it_lapsed(line, clock):
    permit(line, clock, 1, until_ms=80)
    clock.advance_ns(80 * MS)
    line.hold(HoldReason.JUMP)
    assert line.edges == (on(0), off(80))
    clock.advance_ns(MS)
    permit(line, clock, 2, until_ms=161)
    assert line.edges == (on(0), off(80), on(81))


def test_a_hold_is_an_edge_with_its_reason_only_where_the_line_was_on(line, clock):
    line.hold(HoldReason.DWELL)
    clock.advance_ns(MS)
    permit(line, clock, 1, until_ms=80)
    clock.advance_ns(MS)
    line.hold(HoldReason.OUTSIDE_WINDOW)
    line.hold(HoldReason.DWELL)
    assert line.edges == (on(1), off(2, HoldReason.OUTSIDE_WINDOW))


@pytest.mark.parametrize(("granted_ms", "goes_on"), [(4, False), (5, False), (6, True)])
def test_a_permit_that_lost_to_another_thread_s_hold_is_no_edge_and_what_follows_is_still_reported(
    line, clock, granted_ms, goes_on
):
    clock.advance_ns(5 * MS)
    line.hold(HoldReason.WATCHDOG)
    clock.advance_ns(5 * MS)
    # As the two threads leave it behind: accepted by one, and held by the other in the same instant.
    line._events.append((10 * MS, Lease(granted_ns=granted_ms * MS, expires_ns=60 * MS, sequence=1)))
    assert line.edges == ((on(10),) if goes_on else ())
    clock.advance_ns(60 * MS)
    line._events.append((70 * MS, Lease(granted_ns=70 * MS, expires_ns=150 * MS, sequence=2)))
    assert line.edges == (*((on(10), off(60)) if goes_on else ()), on(70))


def test_a_closed_line_takes_nothing_and_reads_off(line, clock):
    permit(line, clock, 1)
    line.close()
    assert not line.is_on()
    assert not line.is_settling
    clock.advance_ns(MS)
    with pytest.raises(BeamLineError, match=r"^the line is closed$"):
        permit(line, clock, 2)
    assert line.edges == (on(0), off(0, HoldReason.ENGINE_STOPPED))


def test_a_line_that_is_off_does_not_stand_still_with_its_permit_on(line, clock):
    line.stand_still()
    assert line.still_since_ns is None
    permit(line, clock, 1)
    line.stand_still()
    assert line.still_since_ns == clock.now_ns()


def test_a_receiver_that_saw_nothing_before_the_permit_takes_it(line, clock):
    permit(line, clock, 1)
    assert SimulatedReceiver(line, clock).is_closed()


def test_a_dropped_permit_stays_dropped_in_another_standstill_until_it_was_withdrawn(line, clock):
    receiver = SimulatedReceiver(line, clock)
    permit(line, clock, 1, until_ms=240)
    line.stand_still()
    clock.advance_ns(int(receiver.drop_ms * MS))
    assert not receiver.is_closed()
    line.stand_still()
    assert not receiver.is_closed()
    line.hold(HoldReason.JUMP)
    assert not receiver.is_closed()
    clock.advance_ns(MS)
    permit(line, clock, 2, until_ms=400)
    assert receiver.is_closed()
