"""The latency by a moving plate: true within its uncertainty, and a sentence instead of a number otherwise."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from engine.verification.qa.latency.captured import TimeLog, plate_distance_mm
from engine.verification.qa.latency.plate_timing import latency_by_plate
from engine.verification.qa.latency.results import CameraLatency
from engine.verification.qa.latency.virtual import BEGINS_NS, VirtualCamera, VirtualFaults, virtual_plate
from engine.verification.qa.playing import frames_of
from engine.verification.qa.trace import CommandedTrace

SECONDS = 40.0
TIME_S = np.arange(-1.0, SECONDS + 1.0, 0.02)


def trace_of(position_mm):
    return CommandedTrace(time_s=TIME_S.copy(), position_mm=position_mm)


def irregular(scale=1.0):
    parts = ((6.0, 0.23, 0.3), (3.0, 0.37, 1.1), (2.0, 0.61, 2.0))
    return trace_of(scale * sum(size * np.sin(2 * np.pi * rate * TIME_S + at) for size, rate, at in parts))


def sine(period_s):
    return trace_of(5.0 * np.sin(2 * np.pi * TIME_S / period_s))


def captured(camera):
    log, distance_mm = TimeLog(), []
    camera.open()
    for frame in frames_of(camera, SECONDS):
        log.add(frame)
        distance_mm.append(plate_distance_mm(frame))
    return log.times, np.array(distance_mm)


def estimate(faults, *, plate=None, told=None, late_s=0.0, clock_ms=0.5):
    """Estimate with a plate that moves by ``plate`` and a trace that says ``told``, its clock off by ``late_s``."""
    plate = plate or irregular()
    camera = VirtualCamera(faults, seed=3, seconds=SECONDS, plate=plate)
    zero_ns = BEGINS_NS + round(late_s * 1e9)
    return latency_by_plate(*captured(camera), told or plate, zero_ns=zero_ns, clock_ms=clock_ms)


@pytest.mark.parametrize("delay_ms", [0.0, 20.0, 80.0, 150.0])
@pytest.mark.parametrize("plate", [irregular(), sine(4.0)], ids=["irregular", "sine"])
def test_a_known_delay_is_found_within_the_stated_uncertainty(delay_ms, plate):
    found = estimate(VirtualFaults(delay_ms=delay_ms), plate=plate)
    assert isinstance(found, CameraLatency), found
    assert abs(found.prompt_ms - delay_ms) <= found.uncertainty_ms <= 6.0


@pytest.mark.parametrize(("jitter_ms", "clock_ppm", "lost_share"), [(10.0, 0.0, 0.0), (1.0, 150.0, 0.05)])
def test_jitter_clock_and_lost_frames_do_not_make_it_wrong(jitter_ms, clock_ppm, lost_share):
    faults = VirtualFaults(delay_ms=60.0, jitter_ms=jitter_ms, clock_ppm=clock_ppm, lost_share=lost_share)
    found = estimate(faults)
    assert abs(found.prompt_ms - 60.0) <= found.uncertainty_ms


def test_the_error_of_the_traces_clock_is_part_of_the_uncertainty():
    faults = VirtualFaults(delay_ms=60.0)
    sure, unsure = estimate(faults), estimate(faults, late_s=0.015, clock_ms=16.0)
    assert unsure.uncertainty_ms == pytest.approx(sure.uncertainty_ms + 15.5)
    assert abs(unsure.prompt_ms - 60.0) <= unsure.uncertainty_ms


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ({"told": sine(3.0)}, "does not follow the trace"),
        ({"plate": irregular(), "told": irregular(-1.0)}, "does not follow the trace"),
        ({"plate": irregular(0.5), "told": irregular()}, "0.50 mm for each mm"),
        ({"plate": sine(0.8)}, "more than one delay"),
        ({"plate": irregular(0.1)}, "less than 3 mm"),
        ({"plate": sine(40.0)}, "move faster"),
        ({"late_s": -30.0}, "covers less than half"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_what_cannot_be_told_is_a_sentence_and_never_a_number(case, words):
    found = estimate(VirtualFaults(delay_ms=60.0), **case)
    assert isinstance(found, str)
    assert words in found


@pytest.mark.parametrize(("faults", "words"), [({"lost_share": 0.2}, "lost"), ({"clock_ppm": -400.0}, "400 ppm")])
def test_frames_that_cannot_be_used_are_refused(faults, words):
    assert words in estimate(VirtualFaults(**faults))


def test_a_plate_out_of_view_is_refused():
    made = virtual_plate(VirtualFaults(), seed=1, seconds=SECONDS)
    times, distance_mm = captured(made.source)
    read = made.trace()
    distance_mm[::10] = np.nan
    assert "not in view" in latency_by_plate(times, distance_mm, read.trace, zero_ns=read.zero_ns, clock_ms=1.0)


def test_the_distance_is_that_of_the_middle_and_of_the_nearest_surface_there():
    camera = VirtualCamera(VirtualFaults(), seed=1, seconds=1.0)
    camera.open()
    frame = camera.read(1.0)
    depth = frame.depth_mm.copy()
    depth[:20], depth[28:31, 36:40] = 4000, 0
    assert plate_distance_mm(replace(frame, depth_mm=depth)) == pytest.approx(850.0, abs=0.5)
    assert np.isnan(plate_distance_mm(replace(frame, depth_mm=np.zeros_like(depth))))


@pytest.mark.parametrize("clock_ms", [0.0, 21.0, float("nan")])
def test_the_error_of_the_clock_is_bounded(clock_ms):
    with pytest.raises(InvalidValueError, match="clock_error_ms"):
        estimate(VirtualFaults(), clock_ms=clock_ms)
