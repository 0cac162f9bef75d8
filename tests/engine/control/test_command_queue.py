"""The queue of commands by itself: who waits with whom, and from when on the service's silence counts."""

import pytest

from engine.control.command_queue import MOST_PERSONS, CommandQueue
from engine.core.clock import NS_PER_S, ManualClock
from engine.core.commands import Disarm, HoldBeam
from engine.core.gate_state import HoldReason
from tests.support.control.armed_bench import on_bench
from tests.support.control.loop_bench import after, good

URGENT = [Disarm, HoldBeam]


def queue_at(now_ns, *, longest_silence_ns=0):
    return CommandQueue(clock=ManualClock(now_ns), capacity=4, longest_silence_ns=longest_silence_ns)


@pytest.mark.parametrize("kind", URGENT)
def test_a_person_who_asks_twice_waits_once_and_in_the_newer_place(kind):
    commands = queue_at(5)
    first = commands.submit(kind(operator="ann"))
    commands.submit(kind(operator="bob"))
    assert commands.submit(kind(operator="ann")) is first
    assert [queued.command.operator for queued in commands.take()] == ["bob", "ann"]


@pytest.mark.parametrize("kind", URGENT)
def test_beyond_the_most_persons_a_further_one_joins_the_oldest(kind):
    commands = queue_at(5)
    answers = [commands.submit(kind(operator=f"person {number}")) for number in range(MOST_PERSONS)]
    assert len(set(map(id, answers))) == MOST_PERSONS
    assert commands.submit(kind(operator="one more")) is answers[0]
    assert len(commands.take()) == MOST_PERSONS


def test_silence_counts_from_the_instant_at_which_the_service_was_alive():
    commands = queue_at(1)
    assert commands.take_report(is_armed=True) is None
    commands.note_service(0)
    assert commands.take_report(is_armed=True).reason is HoldReason.SERVICE_SILENT


def test_an_armed_engine_faults_on_the_silence_of_a_service_that_was_noted():
    bench = on_bench([])
    bench.source.script += [
        after(lambda: bench.loop.note_service(bench.clock.now_ns() - 3_600 * NS_PER_S)),
        good,
    ]
    bench.run()
    assert bench.path()[-1] == "fault:service_silent"


def test_another_thread_holds_the_line_for_the_reason_it_gives():
    bench = on_bench([])
    bench.source.script += [after(lambda: bench.loop.hold_line(HoldReason.SERVICE_SILENT)), good]
    bench.run()
    assert bench.hold_reason_of_the_line() is HoldReason.SERVICE_SILENT
