"""The clock of a device that counts with few bits: any true sequence is given back without wraps."""

from hypothesis import given, strategies as st

from engine.capture.camera_process.native import DeviceClock
from engine.capture.oni.reader import missed_between

WRAP = 2**32
STEPS = st.lists(st.integers(-5_000_000, 600_000_000), min_size=1, max_size=50)


@given(st.integers(0, WRAP - 1), STEPS)
def test_times_are_the_true_ones_up_to_whole_periods_also_where_they_go_back(first, steps):
    clock, true_us, before = DeviceClock(WRAP), first, None
    for step in [0, *steps]:
        true_us = max(true_us + step, 0)
        found = clock.unwrapped(true_us % WRAP)
        assert (found - true_us) % WRAP == 0
        if before is not None:
            assert found - before[0] == true_us - before[1]
        before = found, true_us


def test_two_streams_on_either_side_of_a_wrap_stay_together():
    clock = DeviceClock(WRAP)
    assert clock.unwrapped(WRAP - 10_000) == WRAP - 10_000
    assert clock.unwrapped(5_000) == WRAP + 5_000
    assert clock.unwrapped(WRAP - 1_000) == WRAP - 1_000, "the other stream's frame was taken before the wrap"


@given(st.integers() | st.sampled_from([WRAP, -1]))
def test_a_reading_that_the_counter_cannot_show_is_none(reading):
    found = DeviceClock(WRAP).unwrapped(reading)
    assert (found is None) is not (0 <= reading < WRAP)


@given(st.floats(30.03, 30.14), st.lists(st.integers(1, 6), min_size=1, max_size=40))
def test_a_unit_with_a_rate_of_its_own_loses_no_frame_by_it(fps, steps):
    number, time_us = 0, 0.0
    for step in steps:
        later, later_us = number + step, time_us + step * 1e6 / fps
        missed = missed_between((round(time_us), number), (round(later_us), later), 1e6 / 30.0)
        assert missed == step - 1
        number, time_us = later, later_us
