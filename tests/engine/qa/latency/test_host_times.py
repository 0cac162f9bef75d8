"""Device times on the host's clock: the line below all lags."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from engine.qa.latency.captured import HostTimes, fit_host_times

DEVICE_US = np.arange(900, dtype=np.int64) * 33_366 + 5_000_000


def received(late_ms, *, ppm=0.0):
    return (7e9 + (DEVICE_US - DEVICE_US[0]) * 1e3 * (1.0 + 1e-6 * ppm) + late_ms * 1e6).astype(np.int64)


@given(seed=st.integers(0, 10_000), ppm=st.floats(-180.0, 180.0), jitter_ms=st.floats(0.01, 15.0))
def test_no_frame_lies_below_the_line_and_some_lie_on_it(seed, ppm, jitter_ms):
    late_ms = np.random.default_rng(seed).uniform(0.0, jitter_ms, len(DEVICE_US))
    received_ns = np.maximum.accumulate(received(late_ms, ppm=ppm) + np.arange(len(DEVICE_US)))
    found = fit_host_times(DEVICE_US, received_ns)
    if isinstance(found, str):
        assert abs(ppm) > 150.0
        return
    over_ns = received_ns - found.of(DEVICE_US)
    assert over_ns.min() > -1e3
    assert np.sum(over_ns < 1e3) >= 2
    assert found.rate_error_ppm == pytest.approx(ppm, abs=40.0)


@pytest.mark.parametrize("busy", [slice(600, None), slice(0, 300)], ids=["last third", "first third"])
def test_the_line_is_the_nearest_one_to_all_lags(busy):
    """A host that is busy for a while does not turn the line."""
    late_ms = np.zeros(len(DEVICE_US))
    late_ms[busy] = 12.0
    found = fit_host_times(DEVICE_US, received(late_ms))
    assert isinstance(found, HostTimes)
    assert abs(found.rate_error_ppm) < 1.0
    assert found.of(DEVICE_US[:1])[0] == pytest.approx(7e9, abs=1e3)


@pytest.mark.parametrize(
    ("device_us", "received_ns", "words"),
    [
        (DEVICE_US[::-1], received(0.0), "do not increase"),
        (DEVICE_US, received(0.0)[::-1], "do not increase"),
        (DEVICE_US[:1], received(0.0)[:1], "do not increase"),
        (DEVICE_US + (np.arange(900) > 400) * 2_000_000, received(0.0), "no frame came for 2.0 s"),
        (DEVICE_US, received(0.0, ppm=250.0), "250 ppm"),
    ],
)
def test_times_that_cannot_be_used_are_named(device_us, received_ns, words):
    assert words in fit_host_times(device_us, received_ns)
