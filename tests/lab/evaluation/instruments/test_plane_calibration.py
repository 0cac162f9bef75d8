"""The plane's file, and the plane from pictures of a board: true, honest, refused when it must be."""

import json

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from engine.calibration.laser_plane import LaserPlaneError, load_plane
from engine.calibration.procedures.boards import Board
from engine.capture.oni.writer import OniWriter
from engine.core.errors import InvalidValueError
from lab.evaluation.instruments.board import LitBoard, read_board
from lab.evaluation.instruments.plane_calibration import fit_plane
from service.cli import app
from tests.support.evaluation.laser_boards import BOARD, POSES, RIG, draw, held, laser_plane

pytestmark = pytest.mark.slow

PLANE = laser_plane()


@pytest.fixture(scope="module")
def pictures():
    return [draw(pose, PLANE, seed=seed) for seed, pose in enumerate(POSES)]


@pytest.fixture(scope="module")
def boards(pictures):
    return [(f"picture {index}", read_board(picture, BOARD, RIG.color)) for index, picture in enumerate(pictures)]


def angle_deg(one, other):
    return float(np.degrees(np.arccos(min(float(one.normal @ other.normal), 1.0))))


def test_the_plane_is_found_from_five_pictures(boards):
    found = fit_plane(boards, RIG.calibration)
    assert angle_deg(found.plane, PLANE) < 0.1
    # What counts: where the plane is, at the depths that a chest has.
    for depth_mm in (780.0, 850.0, 920.0):
        y_mm = (PLANE.distance_mm - PLANE.normal[2] * depth_mm) / PLANE.normal[1]
        assert found.plane.normal @ (0.0, y_mm, depth_mm) == pytest.approx(found.plane.distance_mm, abs=0.25)
    assert found.plane.rms_mm < 0.4
    assert found.plane.pictures == 5
    assert found.plane.calibration_sha256 == RIG.calibration.sha256
    assert [seen.is_outlier for seen in found.pictures] == [False] * 5
    assert max(seen.reprojection_px for seen in found.pictures) < 0.2


def test_pictures_of_one_pose_are_one_line_and_no_plane(boards):
    with pytest.raises(LaserPlaneError, match=r"pictures is '\d\.\d mm apart across the line': must be 10 mm or more"):
        fit_plane([boards[0], ("again", boards[0][1])], RIG.calibration)


def test_one_picture_is_not_enough(boards):
    with pytest.raises(LaserPlaneError, match="pictures is '1 that show the line on the board': must be 2 or more"):
        fit_plane(boards[:1], RIG.calibration)


def test_a_picture_taken_after_the_laser_was_knocked_is_named_and_left_out(boards):
    knocked = boards[2][1].points_mm + np.array([0.0, 9.0, 0.0])
    spoiled = [*boards[:2], ("knocked", LitBoard(reprojection_px=0.1, points_mm=knocked)), *boards[3:]]
    found = fit_plane(spoiled, RIG.calibration)
    assert [seen.name for seen in found.pictures if seen.is_outlier] == ["knocked"]
    assert found.plane.pictures == 4
    assert angle_deg(found.plane, PLANE) < 0.15
    assert found.pictures[2].rms_mm > 4.0


def test_pictures_that_no_plane_fits_are_refused(boards):
    bent = [
        (name, LitBoard(reprojection_px=0.1, points_mm=board.points_mm + np.array([0.0, shift, 0.0])))
        for (name, board), shift in zip(boards, (0.0, 14.0, -13.0, 22.0, -20.0), strict=True)
    ]
    with pytest.raises(LaserPlaneError, match=r"rms_mm is .*: must be at most 3 mm"):
        fit_plane(bent, RIG.calibration)


def test_a_picture_without_a_board_or_without_a_line_states_it(pictures):
    gray = np.full((480, 640, 3), 90, dtype=np.uint8)
    assert read_board(gray, BOARD, RIG.color) == "no board of 9 x 6 inner corners"
    dark = draw(POSES[0], PLANE, light=0.0)
    assert read_board(dark, BOARD, RIG.color) == "no laser line on the board"


def test_a_line_up_and_down_the_board_is_found_too():
    turned = laser_plane(lean_deg=38.0)
    normal = turned.normal[[1, 0, 2]]
    upright = type(turned)(
        camera="c", normal=normal, distance_mm=turned.distance_mm, rms_mm=0.0, pictures=0, calibration_sha256="0" * 64
    )
    seen = read_board(draw(held(850.0, 3.0, -4.0, roll_deg=4.0), upright), BOARD, RIG.color)
    assert seen.points_mm @ upright.normal == pytest.approx(upright.distance_mm, abs=1.0)


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"columns": 2}, "columns"),
        ({"rows": 51}, "rows"),
        ({"square_mm": 0.0}, "square_mm"),
        ({"square_mm": float("nan")}, "square_mm"),
    ],
)
def test_a_board_that_is_none_is_refused(arguments, field):
    with pytest.raises(InvalidValueError, match=rf"{field} is .*: must be from"):
        Board(**{"columns": 9, "rows": 6, "square_mm": 30.0, **arguments})


# -- the file -----------------------------------------------------------------------------------------------------


def test_a_plane_written_is_the_plane_read(tmp_path):
    PLANE.save(tmp_path / "plane.json")
    read = load_plane(tmp_path / "plane.json")
    assert read.normal == pytest.approx(PLANE.normal, abs=1e-15)
    assert read.to_json() == (tmp_path / "plane.json").read_text()
    assert [path.name for path in tmp_path.iterdir()] == ["plane.json"]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"schema": "tidegate.laser-plane/2"}, "schema"),
        ({"more": 1}, "more"),
        ({"camera": None}, "camera"),
        ({"normal": [0.0, 1.0]}, "normal"),
        ({"normal": [0.0, 1.0, 0.5]}, "normal"),
        ({"normal": [0.0, "1", 0.0]}, "normal[1]"),
        ({"distance_mm": 0.0}, "distance_mm"),
        ({"distance_mm": -400.0}, "distance_mm"),
        ({"distance_mm": True}, "distance_mm"),
        ({"rms_mm": -0.1}, "rms_mm"),
        ({"pictures": 2.5}, "pictures"),
        ({"calibration_sha256": "abc"}, "calibration_sha256"),
    ],
)
def test_a_file_that_is_no_plane_is_refused_by_field(tmp_path, change, field):
    path = tmp_path / "plane.json"
    path.write_text(json.dumps({**json.loads(PLANE.to_json()), **change}))
    with pytest.raises(LaserPlaneError) as caught:
        load_plane(path)
    assert caught.value.field == field


def test_a_plane_with_a_key_missing_or_no_json_is_refused(tmp_path):
    path = tmp_path / "plane.json"
    document = json.loads(PLANE.to_json())
    del document["normal"]
    for text in (json.dumps(document), "", "[]", '{"schema": NaN}', "x" * 70_000):
        path.write_text(text)
        with pytest.raises(LaserPlaneError):
            load_plane(path)
    with pytest.raises(LaserPlaneError, match="readable"):
        load_plane(tmp_path / "missing.json")


def test_rays_that_meet_the_plane_behind_the_camera_meet_it_nowhere():
    rays = np.array([[0.0, 0.3, 1.0], [0.0, -3.0, 1.0]])
    points = PLANE.meet(rays)
    assert points[0] @ PLANE.normal == pytest.approx(PLANE.distance_mm)
    assert np.isnan(points[1]).all()


# -- the command --------------------------------------------------------------------------------------------------


def invoke(folder, *files, out="plane.json"):
    (folder / "calibration.json").write_text(RIG.calibration.to_json())
    options = ["--columns", "9", "--rows", "6", "--square-mm", "30", "--calibration", str(folder / "calibration.json")]
    arguments = ["evaluate", "plane", *map(str, files), *options, "--out", str(folder / out)]
    return CliRunner().invoke(app, arguments)


def test_the_command_finds_the_plane_and_names_what_it_left_out(pictures, tmp_path):
    files = [tmp_path / f"{index}.png" for index in range(3)]
    for file, picture in zip(files, pictures[:3], strict=True):
        cv2.imwrite(str(file), picture[..., ::-1])
    cv2.imwrite(str(tmp_path / "empty.jpg"), np.full((480, 640, 3), 90, np.uint8))
    outcome = invoke(tmp_path, *files, tmp_path / "empty.jpg")
    assert outcome.exit_code == 0, outcome.stderr
    assert angle_deg(load_plane(tmp_path / "plane.json"), PLANE) < 0.15
    assert "empty.jpg: left out, no board of 9 x 6 inner corners" in outcome.stderr
    assert "over 3 pictures" in outcome.stdout


def test_frames_of_a_recording_are_pictures_too(pictures, tmp_path):
    with OniWriter(tmp_path / "board.oni", fps=30.0) as writer:
        for index, picture in enumerate(pictures[:3]):
            writer.write_depth(1_000 + 33_333 * index, np.full((480, 640), 850, np.uint16))
            writer.write_color(2_000 + 33_333 * index, picture)
    outcome = invoke(tmp_path, tmp_path / "board.oni")
    assert outcome.exit_code == 0, outcome.stderr
    assert angle_deg(load_plane(tmp_path / "plane.json"), PLANE) < 0.15
    assert "board.oni frame 2" in outcome.stdout


def test_the_command_refuses_in_one_line(pictures, tmp_path):
    cv2.imwrite(str(tmp_path / "one.png"), pictures[0][..., ::-1])
    cv2.imwrite(str(tmp_path / "small.png"), pictures[0][::2, ::2, ::-1])
    (tmp_path / "text.png").write_text("no picture")
    for files, words in (
        (["one.png"], "pictures is '1 that show the line on the board': must be 2 or more"),
        (["small.png"], "small.png is '320x240': must be 640x480"),
        (["text.png"], "must be a PNG or JPEG picture, or an .oni recording"),
        (["missing.png"], "must be readable"),
        (["missing.oni"], "missing.oni"),
    ):
        outcome = invoke(tmp_path, *(tmp_path / name for name in files))
        assert outcome.exit_code == 2
        assert words in outcome.stderr
        assert len(outcome.stderr.strip().splitlines()) == 1
        assert not (tmp_path / "plane.json").exists()
