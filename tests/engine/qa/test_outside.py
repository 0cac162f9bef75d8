"""How long the beam is on while the phantom is outside of the window, with beams whose faults are known."""

import numpy as np
import pytest

from engine.qa.motion import longest_outside_s
from engine.qa.trace import CommandedTrace

PERIOD_S = 4.0
BELOW, ABOVE = (-60.0, 10.0), (10.0, 60.0)
TURNS = range(1, 9)


def trace():
    """A cosine of 10 mm around 10 mm from its top: below the window's edge in the middle half of each period."""
    time_s = np.arange(0.0, 10 * PERIOD_S, 0.02)
    return CommandedTrace(time_s=time_s, position_mm=10.0 + 10.0 * np.cos(2.0 * np.pi * time_s / PERIOD_S))


def beam(on_s=0.0, off_s=0.0):
    return [(PERIOD_S * turn + 1.0 + on_s, PERIOD_S * turn + 3.0 + off_s) for turn in TURNS]


def outside_ms(intervals, window=BELOW, from_s=PERIOD_S, to_s=9 * PERIOD_S):
    return 1e3 * longest_outside_s(trace(), window, intervals, from_s, to_s)


def about(wanted_ms):
    return pytest.approx(wanted_ms, abs=3.0)


def test_a_beam_that_is_on_where_the_phantom_is_inside_was_never_outside():
    assert outside_ms(beam()) == about(0.0)
    assert outside_ms(beam(on_s=0.3, off_s=-0.3)) == 0.0
    assert outside_ms([]) == 0.0


@pytest.mark.parametrize(("on_s", "off_s", "wanted_ms"), [(0.1, 0.06, 60.0), (-0.2, 0.0, 200.0), (0.0, 0.15, 150.0)])
def test_a_late_off_and_an_early_on_count_for_so_long(on_s, off_s, wanted_ms):
    assert outside_ms(beam(on_s, off_s)) == about(wanted_ms)


def test_one_late_off_among_many_counts_in_full():
    late = beam(off_s=0.03)
    late[4] = (late[4][0], late[4][1] + 0.5)
    assert outside_ms(late) == about(530.0)


def test_a_pulse_that_meets_no_window_counts_whole():
    assert outside_ms([*beam(off_s=0.03), (19.8, 20.1)]) == about(330.0)
    assert outside_ms([*beam(), (19.8, 20.1)]) == about(300.0)


def test_what_flickers_in_one_excursion_is_added_up_and_that_of_two_is_not():
    flickers = [(19.5 + 0.2 * number, 19.6 + 0.2 * number) for number in range(4)]
    assert outside_ms([*beam(), *flickers]) == about(400.0)
    assert outside_ms([*beam(), (19.8, 20.0), (23.8, 24.0)]) == about(200.0)


def test_a_beam_that_stays_on_from_one_window_to_the_next_was_outside_all_that_way():
    assert outside_ms([(5.0, 11.0)]) == about(2000.0)


def test_a_window_from_above_is_left_at_its_lower_edge():
    tops = [(PERIOD_S * turn - 1.0, PERIOD_S * turn + 1.25) for turn in TURNS]
    assert outside_ms(tops, ABOVE) == about(250.0)


def test_only_what_lies_between_the_two_times_and_within_the_trace_is_looked_at():
    early, late = (3.2, 3.8), (36.0, 36.5)
    assert outside_ms([early, *beam()], to_s=35.0) == about(0.0)
    assert outside_ms([*beam(), late], to_s=35.0) == about(0.0)
    assert outside_ms([*beam(), late], to_s=1e6) == about(500.0)


def test_where_the_trace_reports_nothing_nothing_is_measured():
    assert longest_outside_s(trace(), BELOW, beam(), 1e5, 1e6) is None
