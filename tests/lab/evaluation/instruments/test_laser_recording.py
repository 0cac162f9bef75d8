"""`tidegate evaluate laser` on a virtual volunteer: the instrument against its own truth, and the command."""

import csv
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from engine.calibration.camera_calibration import load_calibration
from engine.calibration.laser_plane import load_plane
from engine.capture.recording_source import OniFileSource
from engine.core.clock import ManualClock
from engine.core.frames import MeasurementState
from engine.motion.settings import PipelineSettings
from engine.motion.stages.roi import color_from_roi
from lab.evaluation.instruments.laser import CELL_PX, LaserGauge
from lab.evaluation.playback import play
from lab.phantom.scene import Scene, Script
from lab.phantom.truth import load_truth
from service.cli import app

ASKED = ((240, 60), (236, 100), (238, 140))


@pytest.fixture(scope="module")
def run(lit_volunteer):
    """Comparison, measurements: the pipeline once, with a gauge looking on."""
    calibration = load_calibration(lit_volunteer / "calibration.json")
    gauge = LaserGauge(calibration, load_plane(lit_volunteer / "plane.json"), points=ASKED)
    settings = PipelineSettings(cell_px=CELL_PX, points=ASKED)
    source = OniFileSource(lit_volunteer / "recording.oni", clock=ManualClock())
    measurements = []
    for frame, measurement in play(source, calibration, settings):
        gauge.add(frame, measurement)
        measurements.append(measurement)
    return gauge.comparison(), measurements


def test_markers_are_found_with_the_laser_on(run):
    _, measurements = run
    assert sum(one.state is MeasurementState.LOST for one in measurements) == 0
    assert sum(one.state is MeasurementState.MEASURING for one in measurements) > 60


def test_the_laser_measures_its_own_true_motion_to_two_tenths_of_a_millimetre(run, lit_volunteer):
    """Where the line lies, in each frame anew: nothing of Tidegate's is in this but the markers that name the place."""
    comparison, _ = run
    truth = load_truth(lit_volunteer / "truth.npz")
    scene = Scene(Script(scenario="regular", volunteer=10, seconds=22.0, fps=10.0, seed=4, has_laser=True))
    is_seen = np.isfinite(comparison.laser_mm).all(axis=1)
    true = []
    for time_us, place in zip(truth.timestamp_us[is_seen], comparison.place_rc[is_seen], strict=True):
        time_s = time_us * 1e-6
        true.append(scene.roi_truth(time_s).depth(place, scene.breathing.weights(time_s)))
    true = np.array(true)
    error = comparison.line_mm[is_seen] - (true[0] - true)
    error -= np.median(error, axis=0)  # both are motion from a frame of their own
    assert np.ptp(true, axis=0).min() > 4.0
    assert np.abs(error).mean(axis=0).max() < 0.2
    assert error.std(axis=0).max() < 0.15


def test_the_line_is_where_the_truth_has_it_in_the_picture(run, lit_volunteer):
    comparison, _ = run
    truth = load_truth(lit_volunteer / "truth.npz")
    is_seen = np.isfinite(comparison.place_rc).all(axis=(1, 2))
    error = []
    for index in np.flatnonzero(is_seen):
        # At the depth frame's time, between two colour frames, as the gauge reads it.
        time_us = truth.timestamp_us[index]
        rows_px = [np.interp(time_us, truth.color_timestamp_us, row) for row in truth.laser_row_px.T]
        places = np.column_stack([comparison.place_rc[index][:, ::-1], np.ones(len(ASKED))])
        pixels = places @ color_from_roi(truth.depth_markers_px[index]).T
        pixels = pixels[:, :2] / pixels[:, 2:]
        error.append(pixels[:, 1] - np.interp(pixels[:, 0], truth.laser_column_px, rows_px))
    assert len(error) > 60
    assert np.abs(np.mean(error, axis=0)).max() < 0.1
    assert np.std(error, axis=0).max() < 0.12


def test_tidegate_s_column_is_the_motion_that_measure_reports(run):
    comparison, measurements = run
    for index, one in enumerate(measurements):
        if one.motion is not None:
            assert comparison.tidegate_mm[index] == pytest.approx(one.motion.points_mm, abs=0.05)


def test_both_instruments_agree_within_the_article_s_error(run):
    comparison, _ = run
    for one in comparison.agreements():
        assert one.frames > 60
        assert one.mean_mm < 0.53
        assert one.largest_mm < 1.4
        assert one.correlation > 0.98
    assert abs(comparison.offset_mm) < 5.0


# -- the command --------------------------------------------------------------------------------------------------


def invoke(folder, out, *extra, plane="plane.json"):
    arguments = ["evaluate", "laser", str(folder / "recording.oni"), "--plane", str(folder / plane)]
    arguments += ["--calibration", str(folder / "calibration.json"), "--out", str(out)]
    return CliRunner().invoke(app, [*arguments, *extra])


def test_the_command_writes_a_table_a_file_and_a_picture(run, lit_volunteer, tmp_path):
    comparison, _ = run
    outcome = invoke(lit_volunteer, tmp_path / "x", *(f"--point={row},{column}" for row, column in ASKED))
    assert outcome.exit_code == 0, outcome.output
    assert sorted(path.name for path in (tmp_path / "x").iterdir()) == ["laser.csv", "laser.png"]
    with (tmp_path / "x" / "laser.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[:4] == ["frame_index", "timestamp_us", "p240_60_laser_mm", "p240_60_tidegate_mm"]
    assert [int(row["timestamp_us"]) for row in rows] == comparison.timestamp_us.tolist()
    for point, (row, column) in enumerate(ASKED):
        for name, values in (("laser", comparison.laser_mm), ("tidegate", comparison.tidegate_mm)):
            texts = [one[f"p{row}_{column}_{name}_mm"] for one in rows]
            numbers = np.array([float(text) if text else np.nan for text in texts])
            assert numbers == pytest.approx(values[:, point], abs=6e-5, nan_ok=True)
    assert (tmp_path / "x" / "laser.png").read_bytes().startswith(b"\x89PNG")
    for point, one in zip(ASKED, comparison.agreements(), strict=True):
        line = next(line for line in outcome.stdout.splitlines() if f"{point[0]},{point[1]}" in line)
        assert f"{one.mean_mm:.3f}" in line
        assert f"{one.correlation:.4f}" in line


def test_another_laser_s_plane_is_refused_in_one_line_and_nothing_is_written(lit_volunteer, tmp_path):
    plane = load_plane(lit_volunteer / "plane.json")
    (tmp_path / "in").mkdir()
    for name in ("recording.oni", "calibration.json"):
        (tmp_path / "in" / name).symlink_to(lit_volunteer / name)
    replace(plane, distance_mm=plane.distance_mm + 60.0).save(tmp_path / "in" / "plane.json")
    outcome = invoke(tmp_path / "in", tmp_path / "x")
    assert outcome.exit_code == 2
    assert "must be at most 50 mm off what the depth camera sees" in outcome.stderr
    assert len(outcome.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        (["--point", "400,0"], "point is '400,0': must be row 0 to 349"),
        (["--point", "middle"], "point is 'middle': must be ROW,COL"),
        (["--head", "north"], "head is 'north': must be one of"),
        (["--components", "0"], "components is 0"),
    ],
)
def test_a_bad_option_is_refused_in_one_line(lit_volunteer, tmp_path, extra, words):
    outcome = invoke(lit_volunteer, tmp_path / "x", *extra)
    assert outcome.exit_code == 2
    assert words in outcome.stderr
    assert len(outcome.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "x").exists()


def test_a_calibration_is_no_plane(lit_volunteer, tmp_path):
    outcome = invoke(lit_volunteer, tmp_path / "x", plane="calibration.json")
    assert outcome.exit_code == 2
    assert "must be one of schema, camera, normal" in outcome.stderr
