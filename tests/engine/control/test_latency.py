"""The statistics of a session's frames: their rate, and their latency in percentiles that are computed now and then."""

import numpy as np
import pytest

from engine.control.records import FRAMES_PER_SUMMARY, LatencyStatistics
from engine.core.clock import NS_PER_MS, NS_PER_S


def counted(latencies_ms, *, period_ns=NS_PER_S // 30, missed_frames=0):
    statistics = LatencyStatistics(warn_latency_ms=50.0)
    for number, latency_ms in enumerate(latencies_ms):
        at_ns = number * period_ns
        statistics.count(
            captured_ns=at_ns,
            received_ns=at_ns,
            asserted_ns=at_ns + round(latency_ms * NS_PER_MS),
            missed_frames=missed_frames,
        )
    return statistics


def test_percentiles_are_those_of_every_eighth_frame_and_the_longest_that_of_all():
    latencies_ms = [float(number) for number in range(1, FRAMES_PER_SUMMARY + 4)]
    found = counted(latencies_ms).latency
    until = latencies_ms[: FRAMES_PER_SUMMARY + 1]
    assert (found.p50_ms, found.p99_ms) == pytest.approx(tuple(np.percentile(until, [50, 99])))
    assert (found.last_ms, found.max_ms) == (latencies_ms[-1], latencies_ms[-1])
    assert counted([40.0, 10.0, 20.0]).latency.max_ms == 40.0
    assert (counted([3.0]).latency.p50_ms, counted([3.0]).latency.p99_ms) == (3.0, 3.0)


@pytest.mark.parametrize(("latency_ms", "is_warned"), [(50.0, False), (50.1, True)])
def test_a_latency_beyond_the_warning_s_bound_is_warned_of(latency_ms, is_warned):
    assert counted([latency_ms]).latency.is_warned is is_warned


def test_missed_frames_add_up_and_what_is_below_none_counts_as_none():
    assert counted([1.0] * 3, missed_frames=2).missed_frames == 6
    assert counted([1.0] * 3, missed_frames=-1).missed_frames == 0


def test_the_rate_is_that_of_the_last_second_its_first_instant_included():
    assert counted([1.0]).fps == 0.0
    assert counted([1.0] * 40, period_ns=NS_PER_S // 10).fps == pytest.approx(10.0)
    statistics = counted([1.0] * 3, period_ns=NS_PER_S // 2)
    assert (statistics.frames, len(statistics._received_ns), statistics.fps) == (3, 3, 2.0)
