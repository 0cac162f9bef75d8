"""Whatever a camera may send: nothing raises, a phase is a phase, and what is sure is so between 0 and 1."""

import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from engine.core.breath import SignalChoice
from engine.motion.breathing import correct_baseline, follow_breathing, shifted, start_breathing, with_baseline
from tests.support.motion.breathing_traces import regular

pytestmark = pytest.mark.slow

AT, VALUE, _ = regular(30.0, fps=15.0)
steps = st.one_of(
    st.floats(0.01, 0.2), st.sampled_from([0.0, -0.1, -50.0, 0.5, 0.6, 3.0, 1e9, math.nan, math.inf, -math.inf])
)
values = st.one_of(
    st.floats(-30.0, 30.0),
    st.floats(allow_nan=True, allow_infinity=True),
    st.sampled_from([0.0, 1e-300, 1e6, -1e6, 1e308, math.nan]),
)


def followed():
    state = start_breathing(SignalChoice())
    for seconds, value in zip(AT.tolist(), VALUE.tolist(), strict=True):
        state = follow_breathing(state, seconds, value)
    return state


FOLLOWED = followed()


def check(breath):
    if breath.phase_percent is None:
        assert breath.note
        assert breath.phase_confidence == 0.0
    else:
        assert 0.0 <= breath.phase_percent < 100.0
        assert breath.note == ""
    for share in (breath.phase_confidence, breath.rate_confidence, breath.regularity or 0.0):
        assert 0.0 <= share <= 1.0
    assert all(0.0 <= event.confidence <= 1.0 for event in breath.events)
    assert len({event.kind for event in breath.events}) == len(breath.events)
    for figure in (breath.rate_per_min, breath.amplitude, breath.baseline, breath.drift, breath.drift_per_s):
        assert figure is None or math.isfinite(figure)


@settings(max_examples=60, deadline=None)
@given(st.booleans(), st.lists(st.tuples(steps, values), min_size=1, max_size=120))
def test_any_input_after_regular_breathing_is_survived(is_volume, frames):
    state = start_breathing(SignalChoice(signal="volume" if is_volume else "whole"))
    for seconds, value in zip(AT.tolist(), VALUE.tolist(), strict=True):
        state = follow_breathing(state, seconds, 0.1 * value if is_volume else value)
    assert state.breath.rate_per_min is not None
    now = AT[-1]
    for step, value in frames:
        state = follow_breathing(state, now + step, value)
        check(state.breath)
        now = now + step if math.isfinite(step) else now


@settings(max_examples=30, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.sampled_from([5.0, 17.0, 60.0]),
    st.sampled_from(["walk", "constant", "jumps", "square", "noise"]),
)
def test_any_kind_of_signal_is_followed_without_harm(seed, fps, shape):
    rng = np.random.default_rng(seed)
    at = np.arange(0.0, 40.0, 1.0 / fps)
    value = {
        "walk": np.cumsum(rng.normal(0.0, 1.0, len(at))),
        "constant": np.full(len(at), rng.uniform(-100.0, 100.0)),
        "jumps": rng.choice([0.0, 50.0, -80.0], len(at)),
        "square": 10.0 * ((at // rng.uniform(0.3, 4.0)) % 2),
        "noise": rng.normal(0.0, 10.0 ** rng.uniform(-3.0, 3.0), len(at)),
    }[shape]
    state = start_breathing(SignalChoice())
    for seconds, one in zip(at.tolist(), value.tolist(), strict=True):
        state = follow_breathing(state, seconds, one)
        check(state.breath)


@settings(max_examples=30, deadline=None)
@given(st.floats(allow_nan=True, allow_infinity=True))
def test_any_shift_and_baseline_is_survived(by):
    state = FOLLOWED
    for change in (shifted, with_baseline, correct_baseline):
        check(change(state, by).breath)


def test_a_clock_that_goes_back_begins_anew_with_the_level_that_was_learned():
    state = follow_breathing(FOLLOWED, 1.0, 0.0)
    assert (state.breath.phase_percent, state.breath.note) == (None, "too little seen yet")
    assert state.history.learned is not None


def test_the_same_values_say_the_same():
    assert followed() == FOLLOWED
