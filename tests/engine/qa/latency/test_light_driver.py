"""The light on a beam line's output: every change between its two times, and a line that is off however it ends."""

import threading
from itertools import pairwise

import pytest

from engine.beam.simulated import SimulatedBeamLine
from engine.core.clock import NS_PER_MS, NS_PER_S, MonotonicClock
from engine.core.errors import BeamLineError
from engine.qa.latency.light_driver import BeamLineLight, intervals_ns
from lab.virtual_qa import StandingTime
from tests.support.qa.faulty_lines import Line, NeverOn
from tests.support.waiting import eventually

INTERVALS = intervals_ns(5, 30.0)


def lit(line_of=SimulatedBeamLine, *, wait=None, intervals=INTERVALS):
    """A light on an open and armed line, on a clock that only waits advance."""
    time = StandingTime()
    line = line_of(time.clock)
    line.open()
    line.rearm()
    return BeamLineLight(line, time.clock, wait or time.wait_ns, intervals), line, time


def test_every_change_lies_between_its_two_times_and_follows_the_pattern():
    light, line, _ = lit()
    light.run()
    edges = [(edge.at_ns, edge.is_on) for edge in line.edges]
    assert (
        [is_on for _, is_on in edges]
        == [change.is_on for change in light.changes]
        == [True, False] * (len(INTERVALS) // 2)
    )
    for (at_ns, _), change in zip(edges, light.changes, strict=True):
        assert change.earliest_ns <= at_ns <= change.latest_ns <= change.earliest_ns + 3 * NS_PER_MS
    steps = [after.earliest_ns - before.earliest_ns for before, after in pairwise(light.changes)]
    assert steps == pytest.approx(INTERVALS[1:], abs=3 * NS_PER_MS)
    assert not line.is_on()


def test_the_light_stays_on_for_phases_longer_than_a_lease():
    light, line, _ = lit(intervals=(150 * NS_PER_MS, 450 * NS_PER_MS))
    light.run()
    (on_ns, _), (off_ns, _) = [(edge.at_ns, edge.is_on) for edge in line.edges]
    assert off_ns - on_ns == pytest.approx(450 * NS_PER_MS, abs=3 * NS_PER_MS)


def test_a_thread_that_is_woken_too_late_ends_the_pattern():
    """The lease may have lapsed between two renewals, and the light was then off unseen."""
    time = StandingTime()
    line = SimulatedBeamLine(time.clock)
    line.open()
    line.rearm()
    light = BeamLineLight(line, time.clock, lambda span_ns: time.wait_ns(span_ns + 160 * NS_PER_MS), INTERVALS)
    with pytest.raises(BeamLineError, match="too busy"):
        light.run()
    assert not line.is_on()


def test_a_line_that_never_goes_on_ends_the_pattern():
    light, line, _ = lit(NeverOn)
    with pytest.raises(BeamLineError, match="never read back on"):
        light.run()
    assert line.calls[-1] == "hold"


def test_in_a_thread_the_failure_is_kept():
    clock = MonotonicClock()
    line = NeverOn(clock)
    light = BeamLineLight(line, clock, lambda _span_ns: None, (1, 1))
    with light.driving():
        eventually(lambda: bool(light.failure), within_s=20.0)
    assert "never read back on" in light.failure
    assert line.calls[-2:] == ["close", "hold"]


@pytest.mark.parametrize("error", [None, KeyboardInterrupt, ValueError])
def test_however_the_block_is_left_the_line_is_held_latched_and_closed(error):
    time = StandingTime()
    line = Line(time.clock)
    light = BeamLineLight(line, time.clock, time.wait_ns, intervals_ns(1, 3000.0))

    def block():
        with light.driving():
            eventually(lambda: len(light.changes) > 3, within_s=20.0)
            if error is not None:
                raise error

    if error is None:
        block()
    else:
        with pytest.raises(error):
            block()
    assert line.calls[-3:] == ["hold", "close", "hold"]  # closing holds too
    assert not line.is_on()
    assert light.failure == ""
    count = len(light.changes)
    time.wait_ns(NS_PER_S)
    assert len(light.changes) == count


def test_the_line_is_held_before_its_thread_is_waited_for():
    """A thread that hangs does not keep the line on until it is given up."""
    clock = MonotonicClock()
    line = Line(clock)
    hangs, is_held = threading.Event(), []

    def wait_ns(_span_ns):
        if line.is_on() and not is_held:
            hangs.set()
            eventually(lambda: line.calls[-1] == "hold", within_s=2.0)
            is_held.append(True)

    light = BeamLineLight(line, clock, wait_ns, (1, 10 * NS_PER_S))
    with light.driving():
        assert hangs.wait(20.0)
    assert is_held == [True]
    assert not line.is_on()


def test_a_line_that_does_not_open_is_closed_and_nothing_is_driven():
    class Shut(Line):
        def open(self):
            raise BeamLineError("nobody answers")

    time = StandingTime()
    line = Shut(time.clock)
    light = BeamLineLight(line, time.clock, time.wait_ns, INTERVALS)
    with pytest.raises(BeamLineError, match="nobody answers"), light.driving():
        pytest.fail("the block was entered")
    assert line.calls[-2:] == ["close", "hold"]
    assert light.changes == []
