"""The latency by a light: true within its stated uncertainty, and a sentence instead of a number otherwise."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from engine.core.clock import NS_PER_MS
from engine.core.errors import InvalidValueError
from engine.qa.latency.captured import CameraLatency, FrameTimes, PictureLog, TimeLog
from engine.qa.latency.light_driver import LightChange, intervals_ns, refuse_pattern
from engine.qa.latency.light_timing import latency_by_light
from engine.qa.playing import frames_of
from lab.virtual_latency import BEGINS_NS, VirtualCamera, VirtualFaults, virtual_light

pytestmark = pytest.mark.verification

SECONDS = 35.0


def captured(given_input):
    """Play a virtual camera; return the times and the pictures."""
    log, pictures = TimeLog(), PictureLog()
    given_input.source.open()
    for frame in frames_of(given_input.source, given_input.seconds):
        log.add(frame)
        pictures.add(frame)
    return log.times, pictures.pictures


def estimate(faults, *, seed=1, seconds=SECONDS, output_ms=0.0):
    made = virtual_light(faults, seed=seed, seconds=seconds)
    return latency_by_light(*captured(made), made.light.changes, output_ms=output_ms)


def with_output(faults, change_ms, *, known_ms, output_ms=0.0, seed=1):
    """Estimate with a light that changes so long after its command, which is read back within ``known_ms``."""
    made = virtual_light(faults, seed=seed, seconds=SECONDS)
    chance = np.random.default_rng(seed)
    at_ns = np.array([change.earliest_ns for change in made.light.changes], dtype=np.float64)
    low, high = change_ms
    shifted = at_ns + chance.uniform(low, high, len(at_ns)) * NS_PER_MS
    camera = VirtualCamera(faults, seed=seed, seconds=SECONDS, light_ns=shifted)
    known = [replace(change, latest_ns=change.earliest_ns + known_ms * NS_PER_MS) for change in made.light.changes]
    return latency_by_light(*captured(replace(made, source=camera)), known, output_ms=output_ms)


@pytest.mark.parametrize("delay_ms", [0.0, 20.0, 80.0, 150.0])
@pytest.mark.parametrize("exposure_ms", [1.0, 8.0, 30.0])
def test_a_known_delay_is_found_within_the_stated_uncertainty(delay_ms, exposure_ms):
    found = estimate(VirtualFaults(delay_ms=delay_ms, exposure_ms=exposure_ms))
    assert isinstance(found, CameraLatency), found
    assert abs(found.prompt_ms - delay_ms) <= found.uncertainty_ms <= 10.0
    assert delay_ms - found.uncertainty_ms <= found.median_ms <= found.p95_ms <= found.worst_ms


@settings(max_examples=12, deadline=None)
@given(
    delay_ms=st.floats(0.0, 300.0),
    jitter_ms=st.floats(0.1, 12.0),
    clock_ppm=st.floats(-150.0, 150.0),
    lost_share=st.floats(0.0, 0.07),
    seed=st.integers(0, 1000),
)
def test_no_delay_jitter_clock_or_loss_makes_it_wrong(delay_ms, jitter_ms, clock_ppm, lost_share, seed):
    faults = VirtualFaults(delay_ms=delay_ms, jitter_ms=jitter_ms, clock_ppm=clock_ppm, lost_share=lost_share)
    found = estimate(faults, seed=seed)
    assert isinstance(found, CameraLatency), found
    assert abs(found.prompt_ms - delay_ms) <= found.uncertainty_ms


def test_later_frames_are_in_the_percentiles_and_not_in_the_prompt_part():
    prompt, late = (estimate(VirtualFaults(delay_ms=50.0, jitter_ms=jitter)) for jitter in (0.1, 12.0))
    assert abs(late.prompt_ms - prompt.prompt_ms) < 1.0
    assert late.median_ms == pytest.approx(prompt.median_ms + 12.0 * np.log(2.0), abs=1.5)
    assert late.p95_ms > late.median_ms + 15.0
    assert late.worst_ms > late.p95_ms


@pytest.mark.parametrize("change_ms", [(0.0, 0.0), (30.0, 30.0), (0.0, 30.0)])
def test_an_output_that_is_read_back_late_widens_the_uncertainty_and_the_truth_stays_inside(change_ms):
    found = with_output(VirtualFaults(delay_ms=80.0), change_ms, known_ms=30)
    assert isinstance(found, CameraLatency), found
    assert abs(found.prompt_ms - 80.0) <= found.uncertainty_ms
    assert found.uncertainty_ms > estimate(VirtualFaults(delay_ms=80.0)).uncertainty_ms


def test_a_light_behind_its_read_back_is_covered_by_the_stated_delay_only():
    slow = (12.0, 12.0)
    told = with_output(VirtualFaults(delay_ms=80.0), slow, known_ms=0, output_ms=15.0)
    assert abs(told.prompt_ms - 80.0) <= told.uncertainty_ms
    untold = with_output(VirtualFaults(delay_ms=80.0), slow, known_ms=0)
    assert abs(untold.prompt_ms - 92.0) <= untold.uncertainty_ms  # on the safe side: the latency is never too small


def test_a_saturated_light_costs_certainty():
    bright = estimate(VirtualFaults(delay_ms=80.0, exposure_ms=30.0, light_step=2000.0))
    assert abs(bright.prompt_ms - 80.0) <= bright.uncertainty_ms
    assert bright.uncertainty_ms > 10.0


@pytest.mark.parametrize(
    ("faults", "words"),
    [
        (VirtualFaults(light_step=0.0), "not in view"),
        (VirtualFaults(is_stuck=True), "always on or off"),
        (VirtualFaults(room_light=255.0), "saturated (255 of 255)"),
        (VirtualFaults(flicker=40.0), "flickers"),
        (VirtualFaults(flicker=200.0, light_step=20.0), "flickers"),
        (VirtualFaults(lost_share=0.2), "% of its frames"),
        (VirtualFaults(clock_ppm=500.0), "clock differs from the host's by 500 ppm"),
        (VirtualFaults(delay_ms=1100.0), "must be 0 to 1000 ms"),
    ],
)
def test_what_cannot_be_reported_is_a_sentence_and_never_a_number(faults, words):
    found = estimate(faults)
    assert isinstance(found, str)
    assert words in found


@settings(max_examples=12, deadline=None)
@given(
    light_step=st.sampled_from([0.0, 1.0, 2.0, 4.0, 90.0]),
    flicker=st.floats(0.0, 120.0),
    lost_share=st.floats(0.0, 0.3),
    room_light=st.floats(0.0, 255.0),
    is_stuck=st.booleans(),
    delay_ms=st.floats(0.0, 1500.0),
    seed=st.integers(0, 1000),
)
def test_whatever_is_wrong_a_number_is_true_or_there_is_none(**faults):
    seed = faults.pop("seed")
    found = estimate(VirtualFaults(**faults), seed=seed)
    assert isinstance(found, str) or abs(found.prompt_ms - faults["delay_ms"]) <= found.uncertainty_ms


def test_a_pattern_that_another_delay_fits_too_is_refused():
    """A light of equal intervals agrees again a period later."""
    made = virtual_light(VirtualFaults(delay_ms=20.0), seed=1, seconds=SECONDS)
    at_ns = BEGINS_NS + 10**9 + np.arange(100, dtype=np.int64) * 200 * NS_PER_MS
    changes = [LightChange(is_on=n % 2 == 0, earliest_ns=at, latest_ns=at) for n, at in enumerate(at_ns.tolist())]
    camera = VirtualCamera(VirtualFaults(delay_ms=20.0), seed=1, seconds=SECONDS, light_ns=at_ns.astype(float))
    found = latency_by_light(*captured(replace(made, source=camera)), changes, output_ms=0.0)
    assert "nearly equal" in found


def test_two_delays_that_fit_are_refused_though_the_intervals_differ():
    """A pattern that repeats itself: irregular within a third of a second, the same again after it."""
    made = virtual_light(VirtualFaults(delay_ms=20.0), seed=1, seconds=SECONDS)
    steps = np.tile([150, 210, 120, 300], 40)
    at_ns = BEGINS_NS + 10**9 + np.cumsum(steps, dtype=np.int64) * NS_PER_MS
    changes = [LightChange(is_on=n % 2 == 0, earliest_ns=at, latest_ns=at) for n, at in enumerate(at_ns.tolist())]
    camera = VirtualCamera(VirtualFaults(delay_ms=20.0), seed=1, seconds=SECONDS, light_ns=at_ns.astype(float))
    found = latency_by_light(*captured(replace(made, source=camera)), changes, output_ms=0.0)
    assert "two delays" in found


def test_changes_of_another_run_are_refused():
    made, other = (virtual_light(VirtualFaults(delay_ms=20.0), seed=seed, seconds=SECONDS) for seed in (1, 2))
    assert "not in view" in latency_by_light(*captured(made), other.light.changes, output_ms=0.0)


@pytest.mark.parametrize("every", [13, 3])
def test_a_tenth_of_the_changes_may_be_wrong_and_more_may_not(every):
    made = virtual_light(VirtualFaults(delay_ms=80.0), seed=1, seconds=SECONDS)
    changes = list(made.light.changes)
    for number in range(0, len(changes), every):
        at = changes[number].earliest_ns + 70 * NS_PER_MS
        changes[number] = replace(changes[number], earliest_ns=at, latest_ns=at)
    found = latency_by_light(*captured(made), changes, output_ms=0.0)
    if every < 10:
        assert isinstance(found, str)
    else:
        assert abs(found.prompt_ms - 80.0) <= found.uncertainty_ms


@pytest.mark.parametrize("output_ms", [-1.0, 51.0, float("nan")])
def test_the_outputs_delay_is_bounded(output_ms):
    made = virtual_light(VirtualFaults(), seed=1, seconds=SECONDS)
    with pytest.raises(InvalidValueError, match="output_delay_ms"):
        latency_by_light(*captured(made), made.light.changes, output_ms=output_ms)


def test_too_few_frames_are_refused():
    made = virtual_light(VirtualFaults(), seed=1, seconds=SECONDS)
    times, pictures = captured(made)
    few = FrameTimes(device_us=times.device_us[:299], received_ns=times.received_ns[:299], missed_frames=0)
    assert "299 frames came: at least 300" in latency_by_light(few, pictures, made.light.changes, output_ms=0.0)


def test_the_pattern_is_irregular_and_as_long_as_asked():
    lengths = intervals_ns(7, 57.0)
    assert intervals_ns(7, 57.0) == lengths != intervals_ns(8, 57.0)
    assert all(150 * NS_PER_MS <= length <= 450 * NS_PER_MS for length in lengths)
    assert 56.0e9 < sum(lengths) <= 57.0e9
    assert {len(intervals_ns(seed, 57.0)) % 2 for seed in range(10)} == {0}
    phases = np.cumsum(lengths) % 33_366_000 / 33_366_000
    assert np.histogram(phases, bins=6, range=(0.0, 1.0))[0].min() > len(lengths) / 15


def changes_at(at_ms, *, known_ms=0):
    return [
        LightChange(
            is_on=number % 2 == 0, earliest_ns=round(at * NS_PER_MS), latest_ns=round((at + known_ms) * NS_PER_MS)
        )
        for number, at in enumerate(at_ms)
    ]


IRREGULAR_MS = np.cumsum(np.random.default_rng(1).uniform(150.0, 450.0, 100))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (changes_at(IRREGULAR_MS[:78]), "changed 39 times"),
        (changes_at(np.where(np.arange(100) == 50, IRREGULAR_MS[49] - 1.0, IRREGULAR_MS)), "increase"),
        (changes_at(IRREGULAR_MS)[:-1] + changes_at([1e9])[:1] * 2, "alternate"),
        (changes_at(IRREGULAR_MS, known_ms=101), "known to 101 ms only"),
        (changes_at(IRREGULAR_MS, known_ms=-1), "increase"),
        (changes_at(IRREGULAR_MS / 4.0), "changed twice within"),
    ],
)
def test_unusable_patterns_are_named(changes, words):
    assert words in refuse_pattern(changes)
    assert refuse_pattern(changes_at(IRREGULAR_MS)) is None
