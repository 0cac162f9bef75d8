"""The queue of commands by itself: who waits with whom, and from when on the service's silence counts."""

from concurrent.futures import Future

import pytest

from engine.control.turn_inputs import MAX_WAIT_NS, MOST_PERSONS, CommandQueue
from engine.core.clock import NS_PER_MS, NS_PER_S, ManualClock
from engine.core.commands import Arm, Disarm, HoldBeam, ReleaseBeam
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import HoldReason
from engine.gating.gate import Interruption
from tests.support.control.armed_bench import on_bench
from tests.support.control.loop_bench import Bench, after, good

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


def test_silence_that_equals_its_bound_is_none_and_a_longer_one_is_reported_while_armed():
    clock = ManualClock(7 * NS_PER_MS)
    commands = CommandQueue(clock=clock, capacity=4, longest_silence_ns=300 * NS_PER_MS)
    commands.note_service(clock.now_ns())
    clock.advance_ns(300 * NS_PER_MS)
    assert commands.take_report(is_armed=True) is None
    clock.advance_ns(1)
    assert commands.take_report() is None
    assert commands.take_report(is_armed=True) == Interruption(
        HoldReason.SERVICE_SILENT, "nothing heard of the service for 300 ms"
    )


def test_a_command_of_another_process_keeps_its_answer_and_its_time():
    bench = Bench([])
    answer = Future()
    assert bench.loop.submit(Disarm(operator="ann"), submitted_ns=7) is not answer
    with pytest.raises(CommandRefusedError, match="disarmed after this command was sent: read the session, then retry"):
        bench.loop.submit(Arm(operator="ann"), answer=answer, submitted_ns=6)
    assert bench.loop.submit(Arm(operator="ann"), answer=answer, submitted_ns=8) is answer


def test_a_refusal_names_the_hold_that_came_after_the_release_was_sent():
    commands = queue_at(5)
    commands.submit(HoldBeam(operator="ann"))
    with pytest.raises(CommandRefusedError) as refusal:
        commands.submit(ReleaseBeam(operator="ann"), submitted_ns=4)
    assert str(refusal.value) == "the beam was held after this command was sent: read the session, then retry"
    commands.submit(Disarm(operator="ann"))
    with pytest.raises(CommandRefusedError) as refusal:
        commands.submit(Arm(operator="ann"), submitted_ns=4)
    assert str(refusal.value) == "disarmed after this command was sent: read the session, then retry"


def test_a_command_waits_as_long_as_it_may_and_is_refused_after_that():
    clock = ManualClock(5)
    commands = CommandQueue(clock=clock, capacity=4)
    answer = commands.submit(Arm(operator="ann"))
    clock.advance_ns(MAX_WAIT_NS)
    assert [queued.answer for queued in commands.take()] == [answer]
    answer = commands.submit(Arm(operator="ann"))
    clock.advance_ns(MAX_WAIT_NS + 1)
    assert commands.take() == []
    assert str(answer.exception(timeout=0)) == "the engine was busy for too long: read the session, then retry"
