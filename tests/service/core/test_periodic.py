"""The worker that repeats a turn: when it starts, waits, fails and ends."""

import logging
import threading

import pytest

from service.core.periodic import PeriodicWorker

LONG_S = 600.0
PATIENCE_S = 30.0


def test_turns_are_repeated_until_the_worker_is_stopped_and_the_last_one_is_done_once():
    done, enough = [], threading.Event()

    def turn() -> None:
        done.append("turn")
        if len(done) >= 3:
            enough.set()

    worker = PeriodicWorker("test", turn, interval_s=0.0, last=lambda: done.append("last"))
    worker.start()
    assert enough.wait(PATIENCE_S)
    worker.stop(PATIENCE_S)
    count = len(done)
    assert done == ["turn"] * (count - 1) + ["last"]
    assert not worker.has_ended
    assert worker.trouble is None


def test_the_first_turn_waits_for_the_interval_and_a_stop_ends_that_wait():
    done = []
    worker = PeriodicWorker("test", lambda: done.append("turn"), interval_s=LONG_S, last=lambda: done.append("last"))
    worker.start()
    worker.stop(PATIENCE_S)
    assert done == ["last"]


def test_the_first_wait_and_what_a_turn_returns_replace_the_interval():
    waits, third = iter((0.0, 0.0, LONG_S)), threading.Event()
    turns = []

    def turn() -> float:
        turns.append(wait_s := next(waits))
        if len(turns) == 3:
            third.set()
        return wait_s

    worker = PeriodicWorker("test", turn, interval_s=LONG_S, first_wait_s=0.0)
    worker.start()
    assert third.wait(PATIENCE_S)
    worker.stop(PATIENCE_S)
    assert turns == [0.0, 0.0, LONG_S]


def test_a_foreseen_error_is_logged_once_until_a_turn_succeeds(caplog):
    results = iter((OSError(), OSError(), TimeoutError(), None, OSError()))
    failed, over = [], threading.Event()

    def turn() -> None:
        error = next(results, over)
        if error is over:
            over.set()
        elif error is not None:
            failed.append(error)
            raise error

    worker = PeriodicWorker("test", turn, interval_s=0.0, recoverable=(OSError,))
    with caplog.at_level(logging.WARNING):
        worker.start()
        assert over.wait(PATIENCE_S)
        worker.stop(PATIENCE_S)
    assert len(failed) == 4
    assert [one.getMessage() for one in caplog.records] == ["test: OSError", "test: TimeoutError", "test: OSError"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_any_other_error_ends_the_thread_and_is_reported():
    def turn() -> None:
        raise ValueError

    worker = PeriodicWorker("test", turn, interval_s=0.0, recoverable=(OSError,))
    assert not worker.has_ended
    worker.start()
    worker._thread.join(PATIENCE_S)
    assert worker.has_ended
    assert worker.trouble == "the thread test has ended: see the service's log"
    worker.stop(PATIENCE_S)
    assert worker.trouble is None


def test_a_worker_that_never_started_can_be_stopped():
    worker = PeriodicWorker("test", lambda: None, interval_s=LONG_S)
    worker.stop(PATIENCE_S)
    assert worker.trouble is None


def test_a_turn_that_hangs_is_left_after_the_timeout():
    hangs, begun = threading.Event(), threading.Event()

    def turn() -> None:
        begun.set()
        hangs.wait(PATIENCE_S)

    worker = PeriodicWorker("test", turn, interval_s=LONG_S, first_wait_s=0.0)
    worker.start()
    assert begun.wait(PATIENCE_S)
    worker.stop(0.0)
    assert worker._thread.is_alive()
    hangs.set()
    worker.stop(PATIENCE_S)
    assert not worker._thread.is_alive()
