"""Orders to the line: what is read back, and what an answer says of a line that failed."""

import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.control.beam_driver import LineOrders
from engine.core.clock import ManualClock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease
from tests.support.control.loop_bench import SteppedWatchdog


class Unreadable(SimulatedBeamLine):
    """Cannot be read back."""

    def is_on(self):
        raise BeamLineError("no answer")


@pytest.fixture
def orders():
    clock = ManualClock(5)
    line = Unreadable(clock)
    return LineOrders(line, clock=clock, watchdog=SteppedWatchdog(beam=line, clock=clock, deadline_ns=1))


def test_a_line_is_connected_and_armed_without_a_read_back(orders):
    """It may answer only once it is connected; what it reads back decides at the next permit or hold."""
    orders.connect()
    orders.rearm()


def test_a_line_that_failed_may_be_on_and_does_not_settle(orders):
    orders.connect()
    orders.rearm()
    for answer in (orders.permit(Lease(granted_ns=6, expires_ns=9, sequence=1)), orders.hold(HoldReason.DWELL)):
        assert (answer.is_on, answer.is_settling, answer.at_ns) == (True, False, 5)
        assert isinstance(answer.error, BeamLineError)
