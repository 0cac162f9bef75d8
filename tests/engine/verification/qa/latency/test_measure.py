"""The stage of a run: figures, verdicts and the camera that was announced."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from engine.core.errors import InvalidValueError, RecordingError
from engine.verification.qa.bounds import QaBaseline, QaBounds
from engine.verification.qa.inputs import QaInputs
from engine.verification.qa.latency.trace_file import read_timed_trace
from engine.verification.qa.latency.virtual import BEGINS_NS, VirtualFaults, virtual_light, virtual_plate
from engine.verification.qa.results import QaKind, QaVerdict
from engine.verification.qa.run import run_qa

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


@pytest.mark.parametrize("make", [virtual_light, virtual_plate])
def test_a_run_has_its_four_figures_and_a_plot(make):
    report = run(make(VirtualFaults(delay_ms=60.0), seed=2, seconds=SECONDS))
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
    assert run(virtual_plate(VirtualFaults(delay_ms=delay_ms), seed=2, seconds=SECONDS)).verdict.value == verdict


def test_without_a_number_every_figure_fails_with_the_reason():
    report = run(virtual_light(VirtualFaults(light_step=0.0), seed=2, seconds=SECONDS))
    assert {(one.value, one.verdict) for one in report.results} == {(None, QaVerdict.FAIL)}
    assert all("not in view" in one.detail for one in report.results)


@pytest.mark.parametrize("make", [virtual_light, virtual_plate])
@pytest.mark.parametrize(
    "other", [{"serial": "OTHER"}, {"fps": 60.0}, {"depth_size": (640, 480)}, {"color_size": (320, 240)}], ids=str
)
def test_another_camera_or_mode_than_the_announced_one_is_not_measured(make, other):
    made = make(VirtualFaults(), seed=2, seconds=SECONDS)
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


@pytest.mark.parametrize(("name", "value"), [("seconds", 29.0), ("seconds", 121.0), ("clock_ms", 0.0)])
def test_the_inputs_of_a_plate_are_bounded(name, value):
    with pytest.raises(InvalidValueError):
        replace(virtual_plate(VirtualFaults(), seed=2, seconds=SECONDS), **{name: value})


OFF_S = 1_800_000_000.25
"""Seconds since 1970 at the monotonic clock's zero, made up."""


def written(tmp_path, *, is_utc, trace, zero_ns, decimals=6):
    """Write a trace with times of one of this machine's clocks."""
    at_s = trace.time_s + zero_ns / 1e9
    rows = []
    for at, position in zip(at_s.tolist(), trace.position_mm.tolist(), strict=True):
        text = datetime.fromtimestamp(at + OFF_S, UTC).isoformat() if is_utc else f"{at:.{decimals}f}"
        rows.append(f"{text},{position:.6f}")
    path = tmp_path / "plate.csv"
    path.write_text("\n".join(["time_utc,position_mm" if is_utc else "monotonic_s,position_mm", *rows]))
    return path


@pytest.mark.parametrize("is_utc", [True, False])
def test_a_file_with_either_clock_gives_the_same_latency(tmp_path, is_utc):
    made = virtual_plate(VirtualFaults(delay_ms=60.0), seed=2, seconds=SECONDS)
    path = written(tmp_path, is_utc=is_utc, trace=made.trace().trace, zero_ns=BEGINS_NS)
    read = read_timed_trace(path, OFF_S)
    by_file, known = run(replace(made, trace=lambda: read)), run(made)
    assert by_file.results[0].value == pytest.approx(known.results[0].value, abs=0.05)
    assert read.sha256 in by_file.results[0].detail
    assert "SHA-256" not in known.results[0].detail


def test_a_trace_that_cannot_be_read_fails_the_run(tmp_path):
    made = virtual_plate(VirtualFaults(), seed=2, seconds=SECONDS)
    missing = run(replace(made, trace=lambda: read_timed_trace(tmp_path / "none.csv", OFF_S)))
    assert "none.csv: cannot be read" in missing.results[0].detail


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "line 1"),
        ("time_s,position_mm\n0,0", "line 1: is 'time_s,position_mm': must be time_utc,position_mm or"),
        ("time_utc,position_mm\n2026-11-23T10:00:00,1", "line 2: '2026-11-23T10:00:00' has no zone"),
        ("time_utc,position_mm\n12.5,1", "line 2: is '12.5,1': must be an RFC 3339 time"),
        ("monotonic_s,position_mm\n1.0,2.0\n1.1,x", "line 3: is '1.1,x': must be seconds and a position"),
        ("monotonic_s,position_mm\n1.0,2.0,3.0", "line 2"),
    ],
)
def test_files_that_are_no_trace_are_refused_by_line(tmp_path, text, words):
    path = tmp_path / "plate.csv"
    path.write_text(text)
    with pytest.raises(RecordingError) as refused:
        read_timed_trace(path, OFF_S)
    assert words in str(refused.value)


@pytest.mark.parametrize("row", ["nan,1", "1.0,inf"])
def test_numbers_that_are_not_finite_are_refused(tmp_path, row):
    path = tmp_path / "plate.csv"
    rows = [f"{n / 10},{n}" for n in range(20)]
    path.write_text("\n".join(["monotonic_s,position_mm", *rows[:5], row, *rows[6:]]))
    with pytest.raises(InvalidValueError):
        read_timed_trace(path, OFF_S)
