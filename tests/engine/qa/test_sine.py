"""The sine method on intervals whose delays are known."""

import numpy as np
import pytest

from engine.qa.sine import FEWEST_CYCLES, find_cycles, time_gate_by_sines
from engine.qa.trace import CommandedTrace

pytestmark = pytest.mark.slow

AMPLITUDE_MM = 10.0
BELOW = (-60.0, 10.0)
ABOVE = (10.0, 60.0)
PERIODS = (2.3, 3.1, 5.3, 8.1)


def trace_of(periods=PERIODS, each=3, *, shape=None):
    lengths = np.repeat(periods, each)
    ends = np.cumsum(lengths)
    time_s = np.arange(0.0, ends[-1], 0.02)
    number = np.searchsorted(ends, time_s, side="right").clip(max=len(lengths) - 1)
    turn = (time_s - (ends[number] - lengths[number])) / lengths[number]
    wave = np.cos(2.0 * np.pi * turn) if shape is None else shape(turn)
    return CommandedTrace(time_s=time_s, position_mm=AMPLITUDE_MM * (1.0 + wave))


def cycles_of(window=BELOW, level_mm=0.0, **given):
    edges = tuple(edge + (level_mm if edge == 10.0 else 0.0) for edge in window)
    return find_cycles(trace_of(**given), edges, 0.0, 1000.0)


def beam(cycles, on_ms=0.0, off_ms=0.0):
    return [(cycle.on_s + on_ms / 1e3, cycle.off_s + off_ms / 1e3) for cycle in cycles]


def test_cycles_are_found_with_their_crossings_turning_points_and_periods():
    cycles = cycles_of(periods=(4.0,), each=6)
    assert len(cycles) == 4  # the first and the last have no whole sine around them
    for number, cycle in enumerate(cycles, start=1):
        assert cycle.middle_s == pytest.approx(4.0 * number + 2.0, abs=2e-3)
        assert cycle.length_s == pytest.approx(2.0, abs=2e-3)
        assert cycle.period_s == pytest.approx(4.0, abs=2e-3)


def test_a_window_from_above_has_its_turning_points_at_the_top():
    cycles = cycles_of(window=ABOVE, periods=(4.0,), each=6)
    assert [cycle.middle_s for cycle in cycles] == pytest.approx([8.0, 12.0, 16.0], abs=2e-3)


@pytest.mark.parametrize("window", [BELOW, ABOVE], ids=["exhale", "inhale"])
@pytest.mark.parametrize(("on_ms", "off_ms"), [(0, 0), (60, 60), (150, 150), (120, 20), (20, 120), (-40, 10)])
def test_delays_are_distinguished_with_their_signs(window, on_ms, off_ms):
    cycles = cycles_of(window)
    found = time_gate_by_sines(cycles, beam(cycles, on_ms, off_ms))
    assert found.mean_s.value == pytest.approx((on_ms + off_ms) / 2e3, abs=1e-3)
    assert found.difference_s.value == pytest.approx((off_ms - on_ms) / 1e3, abs=5e-3)
    assert found.on_s.value == pytest.approx(on_ms / 1e3, abs=4e-3)
    assert found.off_s.value == pytest.approx(off_ms / 1e3, abs=4e-3)


def test_a_wrong_level_moves_neither_figure_but_the_duty():
    cycles, lower = cycles_of(), cycles_of(level_mm=2.0)
    found = time_gate_by_sines(cycles, beam(lower, 80.0, 30.0))
    assert found.mean_s.value == pytest.approx(0.055, abs=1e-3)
    assert found.difference_s.value == pytest.approx(-0.05, abs=5e-3)
    wanted = np.arcsin(0.2) / np.pi - 0.05 / np.mean([cycle.span_s for cycle in cycles])
    assert found.duty_change == pytest.approx(wanted, abs=2e-3)


def test_with_one_period_the_level_is_in_the_difference_and_that_is_stated():
    cycles = cycles_of(periods=(4.0,), each=9)
    found = time_gate_by_sines(cycles, beam(cycles, 80.0, 30.0))
    assert not found.has_periods
    assert found.difference_s.value == pytest.approx(-0.05, abs=1e-6)
    assert time_gate_by_sines(cycles_of(), beam(cycles_of())).has_periods


@pytest.mark.parametrize("percent", [-3.0, 3.0])
def test_a_change_of_duty_is_reported_with_its_sign(percent):
    cycles = cycles_of()
    changed = [(cycle.on_s, cycle.off_s + percent / 100.0 * cycle.span_s) for cycle in cycles]
    assert 100.0 * time_gate_by_sines(cycles, changed).duty_change == pytest.approx(percent, abs=0.01)


def test_the_duty_counts_every_part_of_a_broken_interval():
    cycles = cycles_of()
    parts = beam(cycles)
    on_s, off_s = parts.pop(0)
    gap_s = 0.2
    broken = [(on_s, on_s + 0.4), (on_s + 0.4 + gap_s, off_s), *parts]
    found = time_gate_by_sines(cycles, broken)
    total = sum(cycle.span_s for cycle in cycles)
    assert found.duty_change == pytest.approx(-gap_s / total, abs=1e-4)
    assert found.cycles == len(cycles) - 1


def test_one_cut_short_cycle_does_not_move_the_figures():
    cycles = cycles_of()
    cut = beam(cycles, 60.0, 60.0)
    cut[4] = (cut[4][0], cut[4][1] - 0.9)
    found = time_gate_by_sines(cycles, cut)
    assert found.mean_s.value == pytest.approx(0.06, abs=2e-3)
    assert found.difference_s.value == pytest.approx(0.0, abs=5e-3)


def test_noise_shows_in_the_standard_error_and_the_figure_stays_within_it():
    cycles = cycles_of(each=6)
    rng = np.random.default_rng(3)
    errors, sizes = [], []
    for _ in range(60):
        jitter = rng.normal(0.0, 0.015, (len(cycles), 2))
        noisy = [(on + a, off + b) for (on, off), (a, b) in zip(beam(cycles, 50.0, 50.0), jitter, strict=True)]
        found = time_gate_by_sines(cycles, noisy)
        errors.append((found.mean_s.value - 0.05, found.difference_s.value))
        sizes.append((found.mean_s.error, found.difference_s.error))
    for column in (0, 1):
        ratio = np.std(np.array(errors)[:, column]) / np.mean(np.array(sizes)[:, column])
        assert 0.6 < ratio < 1.6


@pytest.mark.parametrize(
    "shape",
    [
        lambda turn: np.cos(2.0 * np.pi * turn) ** 5,
        lambda turn: np.cos(2.0 * np.pi * turn**1.5),
        lambda turn: 4.0 * np.abs(turn - 0.5) - 1.0,
        lambda turn: np.clip(3.0 * (4.0 * np.abs(turn - 0.5) - 1.0), -1.0, 1.0),
    ],
    ids=["peaked", "lopsided", "triangle", "level at both ends"],
)
def test_what_is_no_sine_reports_nothing(shape):
    cycles = cycles_of(shape=shape)
    assert isinstance(time_gate_by_sines(cycles, beam(cycles)), str)


def test_sines_that_meet_inside_the_window_tell_nothing_for_they_have_no_common_turning_point():
    halves = np.tile([2.0, 2.4], 10)
    ends = np.cumsum(halves)
    time_s = np.arange(0.0, ends[-1], 0.02)
    number = np.searchsorted(ends, time_s, side="right").clip(max=len(halves) - 1)
    turn = 0.5 * (number % 2 + (time_s - (ends[number] - halves[number])) / halves[number])
    trace = CommandedTrace(time_s=time_s, position_mm=AMPLITUDE_MM * (1.0 + np.cos(2.0 * np.pi * turn)))
    assert find_cycles(trace, BELOW, 0.0, 1000.0) == []


def test_too_few_cycles_tell_nothing_and_say_how_many_there_were():
    cycles = cycles_of(periods=(3.0,), each=FEWEST_CYCLES + 1)
    assert len(cycles) == FEWEST_CYCLES - 1
    assert "4 cycles" in time_gate_by_sines(cycles, beam(cycles))


@pytest.mark.parametrize("kept", [0, 5])
def test_a_beam_that_hardly_ever_came_on_reports_nothing(kept):
    cycles = cycles_of()
    assert "exactly once" in time_gate_by_sines(cycles, beam(cycles)[:kept])


def test_a_trace_that_is_not_there_has_no_cycles():
    assert find_cycles(trace_of(), BELOW, 2000.0, 3000.0) == []
