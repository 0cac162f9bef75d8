"""The comparison of the beam-on signal with the permit, at the instants and the figures that are its bounds."""

import pytest

from engine.beam.beam_on import BeamOnComparison, Permission
from engine.beam.compared_line import CLOSE_S, REPORT_NS, ComparedBeamLine
from engine.beam.simulated import SimulatedBeamLine
from engine.core.clock import NS_PER_MS, NS_PER_S, ManualClock
from engine.core.gate_state import Lease

MS = NS_PER_MS
SINCE_NS = 1_000 * MS


class Unthreaded(ComparedBeamLine):
    """Its thread is the test's loop."""

    def _start_thread(self):
        """None: the test compares."""


def test_a_violation_leaves_the_state_with_the_next_permit():
    comparison = BeamOnComparison()
    comparison.compare(Permission(), is_on=True, now_ns=SINCE_NS)
    assert comparison.state.violation == "the accelerator reports beam on, and nothing was permitted"
    comparison.compare(Permission(since_ns=SINCE_NS), is_on=True, now_ns=SINCE_NS + MS)
    assert (comparison.violation, comparison.state.violation) == (None, None)


@pytest.mark.parametrize(("short_ns", "is_absent"), [(0, True), (1, False)])
def test_a_beam_is_absent_from_the_bound_itself(short_ns, is_absent):
    comparison = BeamOnComparison(absent_s=2.0)
    permission = Permission(since_ns=SINCE_NS)
    comparison.compare(permission, is_on=True, now_ns=SINCE_NS)
    comparison.compare(permission, is_on=False, now_ns=SINCE_NS + 2 * NS_PER_S - short_ns)
    assert comparison.state.is_absent is is_absent


def test_the_slowest_hold_may_be_quicker_than_a_millisecond():
    comparison = BeamOnComparison()
    for end_ms, off_ms in ((1, 0.25), (100, 0.5), (200, 0.125)):
        comparison.compare(Permission(since_ns=SINCE_NS), is_on=True, now_ns=SINCE_NS + end_ms * MS)
        ended_ns = SINCE_NS + (end_ms + 1) * MS
        comparison.compare(Permission(ended_ns=ended_ns), is_on=False, now_ns=ended_ns + int(off_ms * MS))
    assert (comparison.state.last_off_ms, comparison.state.slowest_off_ms) == (0.125, 0.5)


def line_of(read):
    clock = ManualClock(SINCE_NS)
    line = Unthreaded(SimulatedBeamLine(clock), clock, read)
    line.open()
    line.rearm()
    return clock, line


def test_a_permit_has_ended_at_the_end_of_its_lease_itself():
    signal = [True]
    clock, line = line_of(lambda: signal[0])
    line.permit(Lease(granted_ns=clock.now_ns(), expires_ns=clock.now_ns() + 80 * MS, sequence=1))
    line.compare_once()
    signal[0] = False
    clock.advance_ns(80 * MS)
    line.compare_once()
    assert (line.state.offs, line.state.last_off_ms) == (1, 0.0)


def test_a_beam_without_a_permit_is_reported_again_at_each_period_itself():
    clock, line = line_of(lambda: True)
    reported = []
    line.on_trouble = lambda _reason, _detail: reported.append(clock.now_ns() - SINCE_NS)
    for _ in range(51):
        line.compare_once()
        clock.advance_ns(10 * MS)
    assert reported == [0, REPORT_NS, 2 * REPORT_NS]


def test_the_end_of_its_thread_is_waited_for_a_second_and_no_longer():
    class Hanging:
        joined: list[float] = []  # noqa: RUF012 - one for one test

        def is_alive(self):
            return True

        def join(self, timeout):
            self.joined.append(timeout)

    _, line = line_of(lambda: False)
    line._thread = Hanging()
    line.close()
    assert Hanging.joined == [CLOSE_S]
