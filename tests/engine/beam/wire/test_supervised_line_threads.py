"""The two threads of a wired line, stepped: how long they rest, what ends them, and that no one rings in vain twice."""

import queue

import pytest

from engine.beam.wire import supervised_line
from engine.beam.wire.supervised_line import CLOSE_S, CYCLE_NS, RECONNECT_NS, WiredBeamLine
from engine.core.clock import NS_PER_S
from engine.core.errors import BeamLineError
from tests.support.beam.stepped_line import MS, World


class Stop:
    """An event that is set after so many waits or looks, and notes how long each wait was to be."""

    def __init__(self, times):
        self.left, self.waits = times, []

    def set(self):
        self.left = 0

    def is_set(self):
        self.left -= 1
        return self.left < 0

    def wait(self, seconds):
        self.waits.append(seconds)
        return self.is_set()


class Bell:
    """No one rings; notes how long it was waited for."""

    def __init__(self):
        self.waits = []

    def get(self, timeout):
        self.waits.append(timeout)
        raise queue.Empty


def opened():
    world = World(answer_ms=2)
    world.line.open()
    return world


def test_the_watcher_looks_every_ten_milliseconds_until_the_line_is_closed(monkeypatch):
    line, looks = opened().line, []
    monkeypatch.setattr(line, "watch_once", lambda: looks.append(1))
    line._stop_requested = Stop(3)
    line._watch()
    assert line._stop_requested.waits == [0.01] * 4
    assert len(looks) == 3


def test_the_exchanger_rests_after_each_exchange_and_reportsf_at_its_end():
    world = opened()
    line = world.line
    line._wakeups, line._stop_requested = Bell(), Stop(4)
    commands = len(world.wire.commands)
    line._work()
    # Two turns of a look, an exchange, a look and a rest; a third look ends it, and off is reported once more.
    assert line._wakeups.waits == [CYCLE_NS / NS_PER_S] * 2
    assert len(world.wire.commands) - commands == 3
    assert not world.wire.commands_on
    assert world.wire.closes == 1


def test_an_exchanger_that_is_stopped_during_its_exchange_does_not_rest_any_more():
    world = opened()
    line = world.line
    line._wakeups, line._stop_requested = Bell(), Stop(1)
    line._work()
    assert line._wakeups.waits == []
    assert world.wire.closes == 1


def test_however_often_somebody_rang_there_is_one_exchange_for_it():
    line = opened().line
    for _ in range(5):
        line._wakeups.put(None)
    line._rest()
    assert line._wakeups.empty()


@pytest.mark.parametrize("left_ms", [5, 30])
def test_it_rests_until_the_lease_ends_or_the_next_cycle_whichever_is_first(left_ms):
    world = World(answer_ms=0).opened()
    world.clock.advance_ns(MS)
    world.permit(left_ms)
    assert world.line.rest_ns() == min(left_ms * MS, CYCLE_NS)


def test_a_line_that_is_not_connected_is_tried_four_times_a_second():
    world = opened()
    world.wire.is_refusing = True
    world.line.exchange_once()
    assert world.line.rest_ns() == RECONNECT_NS == NS_PER_S // 4


def test_its_threads_are_named_keep_no_process_alive_and_are_waited_for_a_second_at_its_end(monkeypatch):
    made = []

    class Thread:
        def __init__(self, **options):
            self.options, self.name, self.joined = options, options["name"], []
            made.append(self)

        def start(self):
            """It is not run."""

        def is_alive(self):
            return True

        def join(self, timeout):
            self.joined.append(timeout)

    monkeypatch.setattr(supervised_line.threading, "Thread", Thread)
    world = World(answer_ms=2)
    line = WiredBeamLine(world.wire, world.clock)
    world.line = line
    line.open()
    assert [thread.options for thread in made] == [
        {"target": line._work, "name": "tidegate-beam-line", "daemon": True},
        {"target": line._watch, "name": "tidegate-beam-watch", "daemon": True},
    ]
    line.close()
    assert [thread.joined for thread in made] == [[CLOSE_S]] * 2
    assert line._threads == ()


def test_a_line_that_is_opened_anew_is_latched_whatever_it_was_before():
    world = World(answer_ms=2).opened()
    world.line.open()
    world.clock.advance_ns(MS)
    with pytest.raises(BeamLineError, match="latched off"):
        world.permit()


def test_a_line_that_is_no_longer_polled_has_this_text():
    world = World(answer_ms=2).opened()
    world.clock.advance_ns(201 * MS)
    with pytest.raises(BeamLineError, match=r"^the exchanges with the line have stopped$"):
        world.line.is_on()
