"""What waits for one client: the newest and the gate's changes, never more; what is left out is counted."""

from itertools import pairwise

import pytest

from service.web.stream.client_slot import MAX_BUFFERED, MAX_CHANGES, ClientSlot
from tests.support.stream.fake_runner import JSON, FakeRunner, make_frame

RUNNER = FakeRunner()


def slot(rate_hz: float | None = None) -> ClientSlot:
    return ClientSlot(JSON, rate_hz=rate_hz, now_s=0.0)


def frame(index: int, **options):
    return make_frame(RUNNER, index, **options)


def taken(one: ClientSlot, now_s: float = 0.0) -> list[int]:
    found = []
    while (message := one.take(now_s)) is not None:
        found.append(message.index)
    return found


def test_only_the_newest_waits_and_what_it_replaced_is_counted():
    one = slot()
    for index in range(5):
        one.offer(frame(index), 0.0)
    assert taken(one) == [4]
    assert one.take_skipped() == (4, 0)
    assert one.take_skipped() == (0, 0)
    assert one.total_skipped == 4


def test_a_client_that_keeps_up_misses_nothing():
    one = slot()
    for index in range(5):
        one.offer(frame(index), index / 30)
        assert one.ready.is_set()
        assert taken(one, index / 30) == [index]
        assert not one.ready.is_set()
    assert one.total_skipped == 0


def test_a_change_of_the_gate_waits_beside_the_newest():
    one = slot()
    for index in range(6):
        one.offer(frame(index, is_change=index in {1, 3}), 0.0)
    assert taken(one) == [1, 3, 5]
    assert one.take_skipped() == (3, 0)


def test_changes_that_wait_are_bounded_and_the_oldest_is_counted():
    one = slot()
    for index in range(MAX_CHANGES + 3):
        one.offer(frame(index, is_change=True), 0.0)
    assert taken(one) == list(range(3, MAX_CHANGES + 3))
    assert one.take_skipped() == (3, 3)


def test_what_the_hub_did_not_see_is_reported_as_left_out():
    one = slot()
    one.offer(frame(7, missed=2), 0.0)
    assert one.take_skipped() == (2, 0)
    slow = slot(rate_hz=1.0)
    slow.offer(frame(7, missed=2), 0.0)
    assert slow.take_skipped() == (0, 0)


@pytest.mark.parametrize(("rate_hz", "expected"), [(0.2, 2), (1.0, 6), (5.0, 26), (10.0, 51), (15.0, 76)])
def test_an_asked_rate_is_kept_evenly_and_nothing_counts_as_left_out(rate_hz: float, expected: int):
    one, sent_s = slot(rate_hz=rate_hz), []
    for tick in range(5 * 300 + 1):  # five seconds, looked at as often as the hub looks
        now_s = tick / 300
        if tick % 10 == 0:
            one.offer(frame(tick // 10), now_s)
        one.tick(now_s)
        if one.ready.is_set():
            sent_s += [now_s for _ in taken(one, now_s)]
    assert abs(len(sent_s) - expected) <= 1
    steps = [after - before for before, after in pairwise(sent_s)]
    assert max(abs(step - 1 / rate_hz) for step in steps) < 1 / 25
    assert one.total_skipped == 0


def test_at_each_tick_it_is_the_newest_that_goes_out():
    one = slot(rate_hz=2.0)
    one.offer(frame(0), 0.0)
    assert taken(one, 0.0) == [0]
    for index in range(1, 20):
        one.offer(frame(index), 0.02 * index)
    assert taken(one, 0.4) == []
    assert taken(one, 0.5) == [19]


def test_a_change_goes_out_at_once_however_low_the_rate():
    one = slot(rate_hz=0.2)
    one.offer(frame(0), 0.0)
    assert taken(one, 0.0) == [0]
    one.ready.clear()
    one.offer(frame(1), 0.1)
    assert not one.ready.is_set()
    one.offer(frame(2, is_change=True), 0.2)
    assert one.ready.is_set()
    assert taken(one, 0.2) == [2]


def test_a_busy_client_of_a_rate_misses_ticks_and_is_reported_how_many():
    one = slot(rate_hz=10.0)
    one.offer(frame(0), 0.0)
    assert taken(one, 0.0) == [0]
    one.busy_since_s = 0.0
    for index in range(1, 31):
        one.offer(frame(index), index / 30)
    assert one.take_skipped() == (10, 0), "one for each tenth of a second"
    assert taken(one, 1.1) == [30]


def test_frames_are_kept_for_a_client_that_is_reported_what_it_missed_and_not_without_end():
    one = slot()
    one.start_buffering()
    for index in range(MAX_BUFFERED + 5):
        one.offer(frame(index), 0.0)
    assert taken(one) == []
    assert one.first_buffered.index == 5
    assert [held.index for held in one.stop_buffering()] == list(range(5, MAX_BUFFERED + 5))
    one.offer(frame(999), 0.0)
    assert taken(one) == [999]
    assert one.total_skipped == 0
