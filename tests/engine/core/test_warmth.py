"""How warm a camera is, against the differential equation that it solves."""

import pytest
from hypothesis import given, strategies as st

from engine.core.warmth import COLD_LEFT, Warmth

WARM_UP_S = 1800.0


def test_a_cold_camera_is_warm_after_its_time_and_not_before():
    warmth = Warmth(WARM_UP_S)
    assert warmth.left_s == pytest.approx(WARM_UP_S)
    warmth.run(WARM_UP_S - 1.0)
    assert warmth.left_s == pytest.approx(1.0)
    warmth.run(1.001)
    assert warmth.left_s == 0.0
    assert warmth.cold_share == pytest.approx(COLD_LEFT, rel=1e-3)


def test_a_warm_camera_that_rests_has_to_run_again():
    warmth = Warmth(WARM_UP_S, cold_share=0.0)
    warmth.rest(10.0)
    assert warmth.left_s == 0.0  # some seconds between two sessions cost nothing
    warmth.rest(590.0)
    after_ten_min_s = warmth.left_s
    assert 900.0 < after_ten_min_s < WARM_UP_S
    warmth.rest(12 * 3600.0)
    assert warmth.left_s == pytest.approx(WARM_UP_S, rel=1e-3)


@given(st.lists(st.tuples(st.booleans(), st.floats(0.0, 3000.0)), max_size=8), st.floats(0.0, 1.0))
def test_it_follows_the_equation_of_a_body_that_is_heated(parts, cold):
    """Forward Euler in steps of a tenth of a second, of the share w that is warm: dw/dt = (is_on - w) / constant."""
    warmth, warm = Warmth(WARM_UP_S, cold), 1.0 - cold
    constant_s = WARM_UP_S / 2.302585
    for is_on, seconds in parts:
        (warmth.run if is_on else warmth.rest)(seconds)
        steps = max(round(10.0 * seconds), 1)
        for _ in range(steps):
            warm += (is_on - warm) * seconds / steps / constant_s
    assert warmth.cold_share == pytest.approx(1.0 - warm, abs=1e-3)


def test_frames_count_as_running_and_a_pause_between_them_as_rest():
    counted, expected = Warmth(WARM_UP_S), Warmth(WARM_UP_S)
    for number in range(300):
        counted.frame(number * 10**9)
    expected.run(299.0)
    assert counted.cold_share == pytest.approx(expected.cold_share)
    counted.frame((299 + 240) * 10**9)
    expected.rest(240.0)
    assert counted.cold_share == pytest.approx(expected.cold_share)
    counted.frame(0)  # a clock that goes back warms nothing
    assert counted.cold_share == pytest.approx(expected.cold_share)


def test_what_needs_no_warm_up_is_always_warm():
    warmth = Warmth(0.0)
    warmth.rest(1e6)
    assert (warmth.left_s, warmth.cold_share) == (0.0, 0.0)
