"""What waits for one client: the newest and the gate's changes, never more; what is left out is counted."""

from itertools import pairwise

import pytest

from service.stream.place import MOST_CHANGES, MOST_HELD, Place
from tests.stream.fake_runner import JSON, FakeRunner, make_frame

RUNNER = FakeRunner()


def place(rate_hz: float | None = None) -> Place:
    return Place(JSON, rate_hz=rate_hz, now_s=0.0)


def frame(index: int, **options):
    return make_frame(RUNNER, index, **options)


def taken(one: Place, now_s: float = 0.0) -> list[int]:
    found = []
    while (spoken := one.take(now_s)) is not None:
        found.append(spoken.index)
    return found


def test_only_the_newest_waits_and_what_it_replaced_is_counted():
    one = place()
    for index in range(5):
        one.offer(frame(index), 0.0)
    assert taken(one) == [4]
    assert one.told_skipped() == (4, 0)
    assert one.told_skipped() == (0, 0)
    assert one.left_out == 4


def test_a_client_that_keeps_up_misses_nothing():
    one = place()
    for index in range(5):
        one.offer(frame(index), index / 30)
        assert one.news.is_set()
        assert taken(one, index / 30) == [index]
        assert not one.news.is_set()
    assert one.left_out == 0


def test_a_change_of_the_gate_waits_beside_the_newest():
    one = place()
    for index in range(6):
        one.offer(frame(index, is_change=index in {1, 3}), 0.0)
    assert taken(one) == [1, 3, 5]
    assert one.told_skipped() == (3, 0)


def test_changes_that_wait_are_bounded_and_the_oldest_is_counted():
    one = place()
    for index in range(MOST_CHANGES + 3):
        one.offer(frame(index, is_change=True), 0.0)
    assert taken(one) == list(range(3, MOST_CHANGES + 3))
    assert one.told_skipped() == (3, 3)


def test_what_the_hub_did_not_see_is_told_as_left_out():
    one = place()
    one.offer(frame(7, missed=2), 0.0)
    assert one.told_skipped() == (2, 0)
    slow = place(rate_hz=1.0)
    slow.offer(frame(7, missed=2), 0.0)
    assert slow.told_skipped() == (0, 0)


@pytest.mark.parametrize(("rate_hz", "expected"), [(0.2, 2), (1.0, 6), (5.0, 26), (10.0, 51), (15.0, 76)])
def test_an_asked_rate_is_kept_evenly_and_nothing_counts_as_left_out(rate_hz: float, expected: int):
    one, sent_s = place(rate_hz=rate_hz), []
    for tick in range(5 * 300 + 1):  # five seconds, looked at as often as the hub looks
        now_s = tick / 300
        if tick % 10 == 0:
            one.offer(frame(tick // 10), now_s)
        one.tick(now_s)
        if one.news.is_set():
            sent_s += [now_s for _ in taken(one, now_s)]
    assert abs(len(sent_s) - expected) <= 1
    steps = [after - before for before, after in pairwise(sent_s)]
    assert max(abs(step - 1 / rate_hz) for step in steps) < 1 / 25
    assert one.left_out == 0


def test_at_each_tick_it_is_the_newest_that_goes_out():
    one = place(rate_hz=2.0)
    one.offer(frame(0), 0.0)
    assert taken(one, 0.0) == [0]
    for index in range(1, 20):
        one.offer(frame(index), 0.02 * index)
    assert taken(one, 0.4) == []
    assert taken(one, 0.5) == [19]


def test_a_change_goes_out_at_once_however_low_the_rate():
    one = place(rate_hz=0.2)
    one.offer(frame(0), 0.0)
    assert taken(one, 0.0) == [0]
    one.news.clear()
    one.offer(frame(1), 0.1)
    assert not one.news.is_set()
    one.offer(frame(2, is_change=True), 0.2)
    assert one.news.is_set()
    assert taken(one, 0.2) == [2]


def test_a_busy_client_of_a_rate_misses_ticks_and_is_told_how_many():
    one = place(rate_hz=10.0)
    one.offer(frame(0), 0.0)
    assert taken(one, 0.0) == [0]
    one.busy_since_s = 0.0
    for index in range(1, 31):
        one.offer(frame(index), index / 30)
    assert one.told_skipped() == (10, 0), "one for each tenth of a second"
    assert taken(one, 1.1) == [30]


def test_frames_are_kept_for_a_client_that_is_told_what_it_missed_and_not_without_end():
    one = place()
    one.hold()
    for index in range(MOST_HELD + 5):
        one.offer(frame(index), 0.0)
    assert taken(one) == []
    assert one.first_held.index == 5
    assert [held.index for held in one.release()] == list(range(5, MOST_HELD + 5))
    one.offer(frame(999), 0.0)
    assert taken(one) == [999]
    assert one.left_out == 0
