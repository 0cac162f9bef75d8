"""The line of a QA run: a hold wins, in any order of calls."""

import threading

import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.core.clock import NS_PER_MS, ManualClock, MonotonicClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease
from service.qa.guarded_line import GuardedLine, TakenAwayError


def lease(clock, sequence=1, ms=80):
    now_ns = clock.now_ns()
    return Lease(granted_ns=now_ns, expires_ns=now_ns + ms * NS_PER_MS, sequence=sequence)


class Interrupted(SimulatedBeamLine):
    """A line that is taken away in the middle of a call, where the other thread may come."""

    def __init__(self, clock):
        super().__init__(clock)
        self.interrupt = self.interrupt_late = lambda: None

    def permit(self, lease):
        self.interrupt()
        super().permit(lease)
        self.interrupt_late()

    def rearm(self):
        self.interrupt()
        super().rearm()


@pytest.fixture
def clock():
    return ManualClock(NS_PER_MS)


@pytest.fixture
def far(clock):
    return Interrupted(clock)


@pytest.fixture
def line(far):
    line = GuardedLine(far)
    line.open()
    line.rearm()
    return line


def test_until_it_is_taken_away_it_is_the_line_itself(line, far, clock):
    line.permit(lease(clock))
    assert line.is_on()
    assert far.is_on()
    clock.advance_ns(1)
    line.hold(HoldReason.OPERATOR_HOLD)
    assert not far.is_on()
    assert not line.is_settling
    line.on_trouble = print
    assert far.on_trouble is print
    assert line.on_trouble is print


def test_taken_away_it_is_off_at_once_and_nothing_turns_it_on_again(line, far, clock):
    line.permit(lease(clock))
    line.take_away()
    assert not far.is_on()
    clock.advance_ns(1)
    for attempt in (line.rearm, lambda: line.permit(lease(clock, 2)), line.open):
        with pytest.raises(TakenAwayError):
            attempt()
        assert not far.is_on()
    line.take_away()
    line.close()
    assert line.is_taken_away


@pytest.mark.parametrize("when", ["interrupt", "interrupt_late"])
def test_taken_away_while_a_permit_is_on_its_way_ends_off(line, far, clock, when):
    setattr(far, when, line.take_away)
    with pytest.raises(BeamLineError):
        line.permit(lease(clock))
    assert not far.is_on()
    clock.advance_ns(1)
    with pytest.raises(BeamLineError, match="latched"):
        far.permit(lease(clock, 9))


def test_taken_away_while_it_is_armed_again_stays_latched(line, far, clock):
    far.hold(HoldReason.ENGINE_FAILED)
    far.interrupt = line.take_away
    with pytest.raises(TakenAwayError):
        line.rearm()
    clock.advance_ns(1)
    with pytest.raises(BeamLineError, match="latched"):
        far.permit(lease(clock, 9))
    assert not far.is_on()


def test_a_thread_that_permits_without_end_never_has_the_line_on_after_it_was_taken_away():
    clock = MonotonicClock()
    for _ in range(30):
        far = SimulatedBeamLine(clock)
        line = GuardedLine(far)
        line.open()
        line.rearm()
        has_permitted = threading.Event()

        def permit_on(line=line, has_permitted=has_permitted):
            sequence = 0
            while True:
                sequence += 1
                try:
                    line.permit(lease(clock, sequence, ms=200))
                    has_permitted.set()
                    line.hold(HoldReason.WATCHDOG)
                    line.rearm()
                except BeamLineError:
                    assert line.is_taken_away
                    return

        thread = threading.Thread(target=permit_on)
        thread.start()
        assert has_permitted.wait(10.0)
        line.take_away()
        thread.join(10.0)
        assert not thread.is_alive()
        assert not far.is_on()
