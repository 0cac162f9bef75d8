"""A training job pauses between its steps while a frame is being measured."""

import threading

import pytest

from engine.motion.learning import frames_first
from engine.motion.learning.frames_first import FramesFirst

TIMEOUT_S = 30.0


@pytest.fixture
def first(monkeypatch):
    monkeypatch.setattr(frames_first, "LONGEST_PAUSE_S", TIMEOUT_S)
    return FramesFirst()


def begun(first, done):
    """Start a job of one step; return its thread and the event that it sets before it gives way."""
    is_at_step = threading.Event()

    def job():
        is_at_step.set()
        first.give_way()
        done.append(1)

    thread = threading.Thread(target=job)
    thread.start()
    assert is_at_step.wait(TIMEOUT_S)
    return thread


def test_a_job_waits_until_the_frame_is_measured(first):
    done = []
    with first:
        thread = begun(first, done)
        thread.join(0.05)
        assert thread.is_alive()
        assert done == []
    thread.join(TIMEOUT_S)
    assert done == [1]


def test_a_job_waits_for_no_frame_and_after_a_failed_one_for_none(first):
    done = []
    begun(first, done).join(TIMEOUT_S)
    with pytest.raises(ValueError, match="bad"), first:
        raise ValueError("bad")
    begun(first, done).join(TIMEOUT_S)
    assert done == [1, 1]


def test_a_job_in_the_measuring_thread_does_not_wait_for_itself(first):
    """A replay fits in the thread that measures: waiting there would cost the longest pause at every step."""
    is_over = threading.Event()

    def measured():
        with first:
            first.give_way()
        is_over.set()

    threading.Thread(target=measured, daemon=True).start()
    assert is_over.wait(0.5 * TIMEOUT_S)


def test_a_measurement_that_hangs_stops_no_job(monkeypatch):
    monkeypatch.setattr(frames_first, "LONGEST_PAUSE_S", 0.01)
    first, done = FramesFirst(), []
    with first:
        thread = begun(first, done)
        thread.join(TIMEOUT_S)
        assert done == [1]
