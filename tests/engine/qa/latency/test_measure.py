"""The stage of a run: figures, verdicts and the camera that was announced."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.errors import InvalidValueError
from engine.qa.bounds import QaBaseline, QaBounds
from engine.qa.inputs import QaInputs
from engine.qa.results import QaKind, QaVerdict
from engine.qa.run import run_qa
from lab.virtual_latency import VirtualFaults, virtual_light

SECONDS = 30.0
CODES = (
    "camera_latency_ms",
    "camera_latency_p95_ms",
    "camera_latency_worst_ms",
    "camera_latency_uncertainty_ms",
)


def run(given, on_progress=lambda *_: None):
    return run_qa(
        QaKind.LATENCY, QaInputs(camera=given), bounds=QaBounds(), baseline=QaBaseline(), on_progress=on_progress
    )


def test_a_run_has_its_four_figures_and_a_plot():
    report = run(virtual_light(VirtualFaults(delay_ms=60.0), seed=2, seconds=SECONDS))
    assert tuple(one.code for one in report.results) == CODES
    median, p95, worst, half = (one.value for one in report.results)
    assert 60.0 - half <= median <= p95 <= worst
    assert median <= 63.0 + half
    assert report.results[0].uncertainty == half
    assert report.verdict is QaVerdict.PASS
    (curve,) = report.series[0].curves
    assert np.median(curve.y) == pytest.approx(median, abs=0.1)


@pytest.mark.parametrize(("delay_ms", "verdict"), [(60.0, "pass"), (125.0, "warn"), (160.0, "fail")])
def test_the_latency_is_judged(delay_ms, verdict):
    assert run(virtual_light(VirtualFaults(delay_ms=delay_ms), seed=2, seconds=SECONDS)).verdict.value == verdict


def test_without_a_number_every_figure_fails_with_the_reason():
    report = run(virtual_light(VirtualFaults(light_step=0.0), seed=2, seconds=SECONDS))
    assert {(one.value, one.verdict) for one in report.results} == {(None, QaVerdict.FAIL)}
    assert all("not in view" in one.detail for one in report.results)


@pytest.mark.parametrize(
    "other", [{"serial": "OTHER"}, {"fps": 60.0}, {"depth_size": (640, 480)}, {"color_size": (320, 240)}], ids=str
)
def test_another_camera_or_mode_than_the_announced_one_is_not_measured(other):
    made = virtual_light(VirtualFaults(), seed=2, seconds=SECONDS)
    frames = []
    report = run(
        replace(made, camera=replace(made.camera, **other)), on_progress=lambda _stage, done, _all: frames.append(done)
    )
    assert frames == []
    assert all("another camera or another mode" in one.detail for one in report.results)


def test_a_light_that_could_not_be_driven_gives_no_number():
    made = virtual_light(VirtualFaults(), seed=2, seconds=SECONDS)
    made.light.failure = "the cable is out"
    assert "could not be driven: the cable is out" in run(made).results[0].detail


def test_a_cancelled_run_ends_at_the_next_frame():
    def cancel(_stage, done, _total):
        if done == 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(virtual_light(VirtualFaults(), seed=2, seconds=SECONDS), cancel)


@pytest.mark.parametrize(("name", "value"), [("seconds", 29.0), ("seconds", 121.0), ("output_ms", 51.0)])
def test_the_inputs_of_a_light_are_bounded(name, value):
    with pytest.raises(InvalidValueError):
        replace(virtual_light(VirtualFaults(), seed=2, seconds=SECONDS), **{name: value})
