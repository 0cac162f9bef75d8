import shutil

import numpy as np
import pytest
from typer.testing import CliRunner

from engine.calibration.camera_calibration import load_calibration
from engine.calibration.laser_plane import load_plane
from engine.capture.oni.reader import OniReader
from lab.phantom.laser import LaserTruth, breathe_through, hang_laser, truth_columns
from lab.phantom.recording import FILES, make_volunteer
from lab.phantom.scene import Scene, Script
from lab.phantom.studio import Studio
from lab.phantom.truth import load_truth
from service.cli import app

pytestmark = pytest.mark.slow

TINY = {"volunteer": 4, "seconds": 2.0, "seed": 3, "fps": 5.0}


def lit_studio(volunteer, scenario):
    seconds = 30.0 if scenario == "shift" else 20.0
    made = Studio(Script(scenario=scenario, volunteer=volunteer, seconds=seconds, fps=30.0, seed=1, has_laser=True))
    made._color_camera.expose = lambda scene, _frame, _time_s: scene.copy()
    return made


@pytest.fixture(scope="module")
def lit(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lit") / "one"
    make_volunteer("regular", **TINY, out=folder, workers=1, has_laser=True)
    return folder


@pytest.fixture(scope="module")
def dark(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dark") / "one"
    make_volunteer("regular", **TINY, out=folder, workers=1)
    return folder


def payloads(folder, *, is_depth):
    with OniReader(folder / "recording.oni") as reader:
        return [frame.payload for frame in reader.frames() if frame.is_depth == is_depth]


def test_a_laser_changes_the_colour_pictures_and_nothing_else(lit, dark):
    assert payloads(lit, is_depth=True) == payloads(dark, is_depth=True)
    assert not set(payloads(lit, is_depth=False)) & set(payloads(dark, is_depth=False))
    for name in ("calibration.json", "flow.csv"):
        assert (lit / name).read_bytes() == (dark / name).read_bytes()
    assert sorted(path.name for path in dark.iterdir()) == sorted(FILES)
    assert sorted(path.name for path in lit.iterdir()) == sorted([*FILES, "plane.json"])


def test_a_volunteer_made_again_without_a_laser_keeps_no_plane_of_the_one_before(lit, tmp_path):
    out = tmp_path / "x"
    shutil.copytree(lit, out)
    make_volunteer("regular", **TINY, out=out, workers=1)
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)


def test_only_the_truth_with_a_laser_knows_its_line(lit, dark):
    assert load_truth(dark / "truth.npz").laser_row_px is None
    truth = load_truth(lit / "truth.npz")
    frames, columns = len(truth.color_timestamp_us), len(truth.laser_column_px)
    assert truth.laser_row_px.shape == truth.laser_depth_mm.shape == (frames, columns)
    assert columns > 20
    assert load_plane(lit / "plane.json").calibration_sha256 == load_calibration(lit / "calibration.json").sha256


@pytest.mark.parametrize(
    ("volunteer", "scenario", "time_s"), [(1, "regular", 1.3), (6, "regular", 4.1), (3, "shift", 29.0)]
)
def test_the_line_is_drawn_where_the_truth_has_it(volunteer, scenario, time_s):
    made = lit_studio(volunteer, scenario)
    scene = made.scene
    lit = made.color_frame(7, time_s).astype(float)
    made._laser = None
    added = (lit - made.color_frame(7, time_s))[..., 0]
    columns = truth_columns(scene.markers_px(0.0))
    plane = hang_laser(scene.anatomy, scene.rig, volunteer)
    solver = LaserTruth(plane, scene.rig, scene.color_rays, scene.skin, columns)
    line = solver.line(scene.breathing.weights(time_s), scene.timeline.pose(time_s))
    drawn = []
    for column, row in zip(columns.astype(int), line.row_px, strict=True):
        rows = np.arange(int(row) - 7, int(row) + 9)
        light = added[rows, column]
        drawn.append((light * rows).sum() / light.sum())
    error = np.array(drawn) - line.row_px
    # Speckle shifts the middle of each column's light, as it does in a room.
    assert abs(error.mean()) < 0.04
    assert error.std() < 0.12


def test_the_true_points_of_the_line_lie_in_the_plane_and_on_the_skin():
    scene = Scene(Script(scenario="regular", volunteer=5, seconds=10.0, fps=30.0, seed=1, has_laser=True))
    plane = hang_laser(scene.anatomy, scene.rig, 5)
    columns = truth_columns(scene.markers_px(0.0))
    weights = scene.breathing.weights(3.0)
    line = LaserTruth(plane, scene.rig, scene.color_rays, scene.skin, columns).line(weights, scene.timeline.pose(3.0))
    # The same pixels, met with the skin instead of the plane: the ROI's truth gives the same depth.
    rays = scene.rig.color.rays(np.column_stack([columns, line.row_px]))
    points = plane.meet(rays)
    assert points @ plane.normal == pytest.approx(plane.distance_mm)
    body = scene.rig.color_from_couch.inverse.apply(points)
    height = scene.skin.height(scene.skin.spline(weights), body[:, 0], body[:, 1])
    assert -body[:, 2] == pytest.approx(height, abs=1e-3)
    assert scene.rig.color_from_depth.inverse.apply(points)[:, 2] == pytest.approx(line.depth_mm, abs=1e-3)


def test_the_line_moves_by_several_pixels_with_a_breath():
    scene = Scene(Script(scenario="regular", volunteer=5, seconds=10.0, fps=30.0, seed=1, has_laser=True))
    plane = hang_laser(scene.anatomy, scene.rig, 5)
    solver = LaserTruth(plane, scene.rig, scene.color_rays, scene.skin, np.array([320.0]))
    lines = [solver.line(scene.breathing.weights(t), scene.timeline.pose(t)) for t in np.arange(0.0, 8.0, 0.2)]
    rows, depths = (np.array([getattr(line, name)[0] for line in lines]) for name in ("row_px", "depth_mm"))
    assert np.ptp(rows) > 1.5
    assert np.ptp(depths) > 4.0


def test_the_flow_is_the_true_volume_s_slope_on_a_clock_of_its_own(lit):
    scene = Scene(Script(scenario="regular", volunteer=4, seconds=30.0, fps=5.0, seed=3))
    flow = breathe_through(scene, 21_000)
    volume = np.cumsum(flow.flow_l_per_s) / 100.0
    scene_s = flow.time_s - flow.lag_s + 0.021
    true = scene.skin.volume_l(scene.breathing.weights(scene_s))
    drift = volume - true
    straight = np.polyval(np.polyfit(flow.time_s, drift, 2), flow.time_s)
    assert np.ptp(true) > 0.2
    assert np.abs(drift - straight).max() < 0.03
    assert 0.3 <= abs(flow.lag_s) <= 1.8
    assert float(load_truth(lit / "truth.npz").spirometer_lag_s) == flow.lag_s


def test_the_command_throws_a_laser_when_asked(lit, tmp_path):
    arguments = ["--volunteer", "4", "--seconds", "2", "--seed", "3", "--fps", "5", "--workers", "1", "--laser"]
    outcome = CliRunner().invoke(app, ["phantom", "regular", *arguments, "--out", str(tmp_path / "x")])
    assert outcome.exit_code == 0, outcome.stderr
    for name in (*FILES, "plane.json"):
        assert (tmp_path / "x" / name).read_bytes() == (lit / name).read_bytes(), name
