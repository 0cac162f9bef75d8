"""The lag between regions: true to a fraction of a frame, the same for every cycle's shape, and silent when unsure."""

import itertools

import numpy as np
import pytest

from engine.motion.stages.phase_lag import WINDOW_S, find_lag, follow_lags, start_lags

PAIR = (("thorax", 0, "abdomen", 1),)
DEG = 360.0


def breath(seconds, period_s=4.0, sharpness=1, irregularity=0.0):
    """Inhale and exhale between 0 and 1; cycles of varied length, and a rest at exhale for a sharpness above one."""
    rng = np.random.default_rng(7)
    lengths = period_s * np.clip(1.0 + irregularity * rng.normal(size=100), 0.5, 1.6)
    cycle = np.interp(np.asarray(seconds) + 5.0 * period_s, np.concatenate([[0.0], np.cumsum(lengths)]), np.arange(101))
    return (0.5 - 0.5 * np.cos(2.0 * np.pi * cycle)) ** sharpness


def signals(lag_s, *, fps=30.0, length_s=30.0, thorax_mm=4.0, abdomen_mm=9.0, noise_mm=0.1, jitter_s=0.0005, **shape):
    """Times, and a thorax that does what the abdomen did ``lag_s`` before."""
    rng = np.random.default_rng(3)
    seconds = 100.0 + np.arange(0.0, length_s, 1.0 / fps)
    seconds += rng.uniform(-jitter_s, jitter_s, len(seconds))
    both = np.column_stack([thorax_mm * breath(seconds - lag_s, **shape), abdomen_mm * breath(seconds, **shape)])
    return seconds, both + rng.normal(0.0, noise_mm, both.shape)


def follow(seconds, both, pairs=PAIR):
    state = start_lags(pairs, both.shape[1])
    states = []
    for at, values in zip(seconds, both, strict=True):
        state = follow_lags(state, float(at), values)
        states.append(state)
    return states


def apart_s(lag_s, expected_s, period_s):
    return abs((lag_s - expected_s + 0.5 * period_s) % period_s - 0.5 * period_s)


@pytest.mark.parametrize("lag_s", [0.0, 0.013, 0.3, -0.7, 1.4, 2.0])
@pytest.mark.parametrize(
    "shape",
    [{}, {"sharpness": 3}, {"irregularity": 0.12}, {"period_s": 3.3}, {"period_s": 6.5}],
    ids=["sine", "rest at exhale", "irregular", "quick", "slow"],
)
def test_the_lag_is_true_to_half_a_frame(lag_s, shape):
    lag = follow(*signals(lag_s, **shape))[-1].lags[0]
    assert apart_s(lag.lag_s, lag_s, lag.period_s) < 0.017
    assert lag.lag_deg == pytest.approx(DEG * lag.lag_s / lag.period_s)
    assert -180.0 < lag.lag_deg <= 180.0
    assert 0.95 < lag.confidence <= 1.0
    assert (lag.first, lag.second, lag.note) == ("thorax", "abdomen", "")
    if "irregularity" not in shape:
        assert lag.period_s == pytest.approx(shape.get("period_s", 4.0), abs=0.03)


def test_later_is_positive_and_swapping_the_two_turns_the_sign():
    seconds, both = signals(0.4, noise_mm=0.0)
    later = find_lag(seconds[::3], both[::3, 0], both[::3, 1], first="thorax", second="abdomen")
    sooner = find_lag(seconds[::3], both[::3, 1], both[::3, 0], first="abdomen", second="thorax")
    assert later.lag_s == pytest.approx(0.4, abs=0.01)
    assert sooner.lag_s == pytest.approx(-later.lag_s, abs=1e-6)


@pytest.mark.parametrize("fps", [6.7, 15.0, 60.0])
def test_the_frame_rate_makes_no_difference(fps):
    assert follow(*signals(0.3, fps=fps))[-1].lags[0].lag_s == pytest.approx(0.3, abs=0.02)


def test_offset_scale_and_drift_make_no_difference():
    seconds, both = signals(0.7)
    drifting = 850.0 + both * (3.0, 1.0) + (seconds - seconds[0])[:, None] * (1.0, 0.5)
    assert follow(seconds, drifting)[-1].lags[0].lag_s == pytest.approx(0.7, abs=0.02)


def test_an_isovolume_manoeuvre_is_half_a_cycle():
    seconds, both = signals(0.0)
    both[:, 0] *= -1.0
    lag = follow(seconds, both)[-1].lags[0]
    assert abs(lag.lag_deg) == pytest.approx(180.0, abs=2.0)


def test_it_follows_a_lag_that_changes_within_the_window():
    seconds, before = signals(0.1, length_s=60.0)
    _, after = signals(0.9, length_s=60.0)
    both = np.where((seconds < 130.0)[:, None], before, after)
    assert follow(seconds, both)[-1].lags[0].lag_s == pytest.approx(0.9, abs=0.02)


def test_it_is_reported_anew_about_once_a_second_and_not_more_often():
    states = follow(*signals(0.3))
    changes = sum(a.lags is not b.lags and a.lags != b.lags for a, b in itertools.pairwise(states))
    assert 15 <= changes <= 30


def test_memory_ends_with_the_window_and_frames_only_add_to_it():
    states = follow(*signals(0.3, length_s=60.0))
    assert states[-1].seconds[-1] - states[-1].seconds[0] <= WINDOW_S
    assert len(states[-1].seconds) <= 201
    with pytest.raises(ValueError, match="read-only"):
        states[-1].signals_mm[0, 0] = 0.0


def test_the_same_frames_give_the_same_lags():
    assert follow(*signals(0.3))[-1].lags == follow(*signals(0.3))[-1].lags


def test_many_pairs_are_each_reported():
    seconds, both = signals(0.3)
    pairs = tuple((f"r{i}", i % 2, "abdomen", 1) for i in range(23))
    lags = follow(seconds, both, pairs)[-1].lags
    assert [lag.first for lag in lags] == [f"r{i}" for i in range(23)]
    assert all(lag.lag_s == pytest.approx(0.0 if i % 2 else 0.3, abs=0.02) for i, lag in enumerate(lags))


# -- when it cannot be determined ---------------------------------------------------------------------------------


def note_of(seconds, both):
    lag = follow(seconds, both)[-1].lags[0]
    assert lag.lag_s is None
    assert lag.lag_deg is None
    return lag.note


def test_nothing_is_reported_of_a_part_that_hardly_moves():
    assert note_of(*signals(0.3, thorax_mm=0.3)) == "thorax moves by less than 0.8 mm"
    assert note_of(*signals(0.3, abdomen_mm=0.3)) == "abdomen moves by less than 0.8 mm"


def test_nothing_is_reported_of_less_than_two_cycles():
    assert note_of(*signals(0.3, length_s=1.0)) == "too little seen yet"
    assert note_of(*signals(0.3, length_s=6.0)) == "too little seen yet"
    assert note_of(*signals(0.3, period_s=14.0)) == "no regular breathing"


def test_nothing_is_reported_of_a_breath_hold():
    seconds, both = signals(0.0, noise_mm=0.0)
    held = np.minimum((seconds - seconds[0])[:, None] / 3.0, 1.0) * (12.0, 4.0) + 0.0 * both
    assert note_of(seconds, held + np.random.default_rng(1).normal(0.0, 0.1, held.shape)) != ""


def test_nothing_is_reported_of_breathing_that_does_not_repeat():
    seconds, both = signals(0.0)
    walk = np.cumsum(np.random.default_rng(5).normal(0.0, 0.3, both.shape), axis=0)
    assert note_of(seconds, walk) in {"no regular breathing", "the two do not move alike"}


def test_nothing_is_reported_of_two_that_do_not_move_alike():
    seconds, both = signals(0.0)
    both[:, 0] = 4.0 * breath(seconds, period_s=1.1) + np.random.default_rng(5).normal(0.0, 0.1, len(seconds))
    both[:, 1] = 4.0 * breath(seconds, period_s=4.4)
    lag = follow(seconds, both)[-1].lags[0]
    assert lag.lag_s is None
    assert lag.note


def test_nothing_is_reported_while_a_region_is_not_measured():
    seconds, both = signals(0.3)
    both[-200:-100, 0] = np.nan
    assert note_of(seconds, both) == "a region is not measured"


def test_a_gap_or_a_clock_that_goes_back_begins_anew():
    seconds, both = signals(0.3)
    for jump_s in (5.0, -50.0):
        jumped = seconds + jump_s * (np.arange(len(seconds)) >= len(seconds) - 30)
        assert note_of(jumped, both) in {"nothing seen yet", "too little seen yet"}


def test_a_few_lost_frames_do_not_matter():
    seconds, both = signals(0.3)
    kept = np.ones(len(seconds), dtype=bool)
    kept[700:720] = kept[800:812] = False
    assert follow(seconds[kept], both[kept])[-1].lags[0].lag_s == pytest.approx(0.3, abs=0.02)
