"""``tidegate calibrate``: from pictures, plates and other software; refusals in one line, nothing half-written."""

import json
import re

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from engine.calibration.camera_calibration import load_calibration
from engine.core.geometry import RigidTransform
from service.cli import app
from tests.support.calibration.camera_pair import CAMERAS, board_poses, draw
from tests.support.calibration.foreign_calibrations import as_yaml, camera_info, ros_pair, storage_values, write_storage
from tests.support.calibration.plate_recordings import plate_depth, record_plate
from tests.support.service.api_calls import make_calibration

pytestmark = [pytest.mark.slow, pytest.mark.verification]

BOARD = ["--columns", "9", "--rows", "6", "--square-mm", "30"]


def run(*arguments):
    return CliRunner().invoke(app, ["calibrate", *(str(argument) for argument in arguments)])


def refusal_of(*arguments):
    result = run(*arguments)
    assert result.exit_code == 2
    assert result.stdout == ""
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert lines[0].startswith(f"tidegate calibrate {arguments[0]}: ")
    return lines[0]


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Eight boards, drawn for both cameras; before the colour camera, number 5 was moved."""
    folder = tmp_path_factory.mktemp("pictures")
    for kind in ("ir", "rgb"):
        (folder / kind).mkdir()
    to_color = CAMERAS.color_from_depth
    for i, pose in enumerate(board_poses(9, seed=4)):
        shift = to_color.apply(pose.translation_mm[None])[0] + (np.array([4.0, 2.0, 0.0]) if i == 5 else 0.0)
        color = RigidTransform(rotation=to_color.rotation @ pose.rotation, translation_mm=shift)
        cv2.imwrite(str(folder / f"ir/pose{i}.png"), draw(CAMERAS.depth, pose, seed=i))
        cv2.imwrite(str(folder / f"rgb/pose{i}.png"), draw(CAMERAS.color, color, seed=50 + i))
    cv2.imwrite(str(folder / "ir/empty.png"), np.full((480, 640), 90, np.uint8))
    cv2.imwrite(str(folder / "rgb/empty.png"), np.full((480, 640), 90, np.uint8))
    cv2.imwrite(str(folder / "rgb/alone.png"), np.full((480, 640), 90, np.uint8))
    return folder


def test_pictures_of_a_board_give_a_calibration_a_report_and_a_picture(pictures, tmp_path):
    out = tmp_path / "made" / "cal.json"
    result = run(
        *("checkerboard", "--depth-pictures", pictures / "ir", "--color-pictures", f"{pictures}/rgb/*.png", *BOARD),
        *("--out", out, "--camera", "Xtion 7"),
    )
    assert result.exit_code == 0, result.stderr
    made = load_calibration(out)
    assert made.camera == "Xtion 7"
    assert made.depth.fx == pytest.approx(CAMERAS.depth.fx, rel=0.003)
    assert made.color.fx == pytest.approx(CAMERAS.color.fx, rel=0.003)
    np.testing.assert_allclose(made.color_from_depth.translation_mm, [25.3, -0.4, 0.7], atol=0.5)
    assert "Outlier, not used: pose5: the two pictures together" in result.stderr
    assert "Not used: empty: the whole board is not seen in empty.png and empty.png" in result.stderr
    assert "Not used: alone.png" in result.stderr
    assert "Note: 8 pairs were used" in result.stderr
    assert re.search(r"At 850 mm: depth and colour agree within 0\.\d\d mm", result.stderr)
    report = json.loads((out.parent / "cal.report.json").read_text())
    assert report["calibration_sha256"] == made.sha256
    assert [picture["name"] for picture in report["pictures"]] == [f"pose{i}" for i in range(9) if i != 5]
    assert report["accuracy"]["alignment_mm"] < 0.2
    assert cv2.imread(str(out.parent / "cal.residuals.png")) is not None
    assert sorted(path.name for path in out.parent.iterdir()) == ["cal.json", "cal.report.json", "cal.residuals.png"]


def test_what_cannot_be_calibrated_is_refused_in_one_line_and_leaves_nothing(pictures, tmp_path):
    out = tmp_path / "cal.json"
    both = ("--depth-pictures", pictures / "ir", "--color-pictures", pictures / "rgb")
    few = ("--depth-pictures", f"{pictures}/ir/pose[01].png", "--color-pictures", f"{pictures}/rgb/pose[01].png")
    none = ("--depth-pictures", f"{pictures}/ir/empty.png", "--color-pictures", f"{pictures}/rgb/empty.png")
    assert "at least 6 pairs" in refusal_of("checkerboard", *few, *BOARD, "--out", out)
    assert "no board in any" in refusal_of("checkerboard", *none, *BOARD, "--out", out)
    assert "rows is 9" in refusal_of("checkerboard", *both, *BOARD, "--rows", 9, "--out", out)
    assert "infrared-offset" in refusal_of("checkerboard", *both, *BOARD, "--infrared-offset", "4", "--out", out)
    assert "camera is ''" in refusal_of("checkerboard", *both, *BOARD, "--camera", "", "--out", out)
    missing = ("--depth-pictures", tmp_path / "no", "--color-pictures", pictures / "rgb")
    assert "depth-pictures is" in refusal_of("checkerboard", *missing, *BOARD, "--out", out)
    assert list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def plates(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plates")
    (folder / "cal.json").write_text(CAMERAS.to_json())
    for distance in (700, 1000):
        record_plate(folder / f"{distance}.oni", plate_depth(distance, tilt_deg=4.0), frames=40, seed=distance)
    return folder


def test_plates_give_a_depth_correction(plates, tmp_path):
    out = tmp_path / "cal.json"
    recordings = [plates / "700.oni", plates / "1000.oni"]
    distances = ("--distance-mm", 700, "--distance-mm", 1000)
    result = run("plate", *recordings, *distances, "--calibration", plates / "cal.json", "--out", out)
    assert result.exit_code == 0, result.stderr
    made = load_calibration(out)
    assert made.depth_correction.scale == pytest.approx(1.013, abs=0.0007)
    assert made.depth == CAMERAS.depth
    assert re.search(r"At 850 mm: depth is accurate within 0\.\d\d mm", result.stderr)
    assert "700.oni" in result.stdout
    assert "quantisation steps of the sensor are corrected" in result.stderr
    assert made.disparity.step_px == pytest.approx(0.12606, abs=3e-4)
    report = json.loads((tmp_path / "cal.report.json").read_text())
    assert report["calibration_sha256"] == made.sha256
    assert [plate["distance_mm"] for plate in report["plates"]] == [700.0, 1000.0]
    assert [plate["drift_mm"] for plate in report["plates"]] == [None, None]  # a second and a bit tell none
    assert "?" in result.stdout


def test_one_plate_states_what_it_does_not_know(plates, tmp_path):
    out = tmp_path / "cal.json"
    result = run("plate", plates / "700.oni", "--distance-mm", 700, "--calibration", plates / "cal.json", "--out", out)
    assert result.exit_code == 0
    assert "one distance determines only the offset" in result.stderr
    assert "too few quantisation steps" in result.stderr
    assert load_calibration(out).depth_correction.scale == 1.0


def test_plates_that_tell_nothing_are_refused_in_one_line_and_leave_nothing(plates, tmp_path):
    out, given = tmp_path / "cal.json", ("--calibration", plates / "cal.json")
    one = ("plate", plates / "700.oni")
    assert "distance-mm is '2 distances'" in refusal_of(
        *one, "--distance-mm", 700, "--distance-mm", 1000, *given, "--out", out
    )
    assert "distance-mm is 70.0" in refusal_of(*one, "--distance-mm", 70, *given, "--out", out)
    assert "lies on a plane" in refusal_of(*one, "--distance-mm", 700, "--part", 1, *given, "--out", out)
    assert "offset_mm" in refusal_of(*one, "--distance-mm", 1200, *given, "--out", out)
    (tmp_path / "no.oni").write_bytes(b"no recording")
    assert "no.oni" in refusal_of("plate", tmp_path / "no.oni", "--distance-mm", 700, *given, "--out", out)
    assert [path.name for path in tmp_path.iterdir()] == ["no.oni"]


def test_calibrations_of_other_software_are_converted(tmp_path):
    storage = tmp_path / "stereo.yml"
    write_storage(storage, storage_values(unit_mm=1000.0))
    out = tmp_path / "cal.json"
    result = run("convert", storage, "--first-camera", "depth", "--camera", "bench 7", "--out", out)
    assert result.exit_code == 0, result.stderr
    assert "taken as metres" in result.stderr
    assert load_calibration(out).color_from_depth.translation_mm == pytest.approx([25.0, -0.5, 1.25])
    files = [tmp_path / "depth.yaml", tmp_path / "rgb.yaml"]
    for path, text in zip(files, ros_pair(), strict=True):
        path.write_bytes(text)
    assert run("convert", *files, "--out", out).exit_code == 0
    assert load_calibration(out).camera == "rgb_PS1080"


def test_what_is_ambiguous_is_asked_for_on_the_command_line(tmp_path):
    files = [tmp_path / "depth.yaml", tmp_path / "rgb.yaml"]
    for path, camera in zip(files, (CAMERAS.depth, CAMERAS.color), strict=True):
        path.write_bytes(as_yaml(camera_info(camera, path.stem)))
    out = tmp_path / "cal.json"
    assert "baseline_mm" in refusal_of("convert", *files, "--out", out)
    assert "baseline_mm" in refusal_of("convert", *files, "--baseline-mm", 900, "--out", out)
    assert "image_size_px" in refusal_of("convert", *files, "--size", "640", "--out", out)
    assert "image_size_px[0]" in refusal_of("convert", *files, "--size", "axb", "--out", out)
    assert "absent.yaml" in refusal_of("convert", tmp_path / "absent.yaml", "--out", out)
    assert not out.exists()
    assert run("convert", *files, "--baseline-mm", 25, "--out", out).exit_code == 0
    pose = tmp_path / "pose.json"
    pose.write_text(json.dumps({"rotation": np.eye(3).tolist(), "translation_mm": [24.0, 1.0, 0.0]}))
    assert run("convert", *files, "--pose", pose, "--out", out).exit_code == 0
    assert load_calibration(out).color_from_depth.translation_mm.tolist() == [24.0, 1.0, 0.0]
    source = tmp_path / "half.json"
    source.write_text('{"rotation": []}')
    assert "depth_to_color" in refusal_of("convert", *files, "--pose", source, "--out", out)


def test_the_serial_number_is_written_and_kept(tmp_path):
    source, out = tmp_path / "plain.json", tmp_path / "cal.json"
    source.write_text(make_calibration().to_json())
    assert run("convert", source, "--serial", "A1", "--out", out).exit_code == 0
    assert load_calibration(out).serial == "A1"
    assert run("convert", out, "--out", source).exit_code == 0
    assert load_calibration(source).serial == "A1"
    assert "serial" in refusal_of("convert", source, "--serial", "a\nb", "--out", out)


def test_a_place_that_cannot_be_written_is_stated_in_one_line(tmp_path):
    source = tmp_path / "a.json"
    source.write_text(CAMERAS.to_json())
    (tmp_path / "file").write_text("")
    assert "cannot be written" in refusal_of("convert", source, "--out", tmp_path / "file" / "cal.json")
