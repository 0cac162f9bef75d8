"""A calibration that cannot be true is refused with the field, the value and the bound."""

import copy
import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, strategies as st

from engine.calibration.camera_calibration import Calibration, least_magnification, load_calibration, parse_calibration
from engine.core.errors import CalibrationError

GOOD = {
    "schema": "tidegate.calibration/1",
    "camera": "Xtion 1234",
    "depth": {"width": 640, "height": 480, "fx": 570, "fy": 571.5, "cx": 319.5, "cy": 239.5, "distortion": [0.0] * 5},
    "color": {"width": 640, "height": 480, "fx": 525.0, "fy": 525.0, "cx": 320.0, "cy": 240.0, "distortion": [0.0] * 5},
    "depth_to_color": {"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "translation_mm": [25.0, 0.0, 0.0]},
    "depth_correction": {"scale": 1.01, "offset_mm": -2.0},
    "disparity": {"baseline_mm": 75.0, "step_px": 0.125},
}
S = np.sqrt(0.5)

WRONG = [
    ("schema", "tidegate.calibration/2", "schema"),
    ("camera", "", "camera"),
    ("camera", "a\nb", "camera"),
    ("depth.width", 0, "depth.width"),
    ("depth.width", 640.5, "depth.width"),
    ("depth.width", True, "depth.width"),
    ("color.height", 10**9, "color.height"),
    ("depth.fx", 1e9, "depth.fx"),
    ("depth.fx", -570, "depth.fx"),
    ("depth.fy", 300, "depth.fy"),
    ("depth.fx", "570", "depth.fx"),
    ("depth.cx", 700, "depth.cx"),
    ("color.cy", -1, "color.cy"),
    ("depth.distortion", [0.0] * 4, "depth.distortion"),
    ("depth.distortion", [0.0, 0.0, 0.0, 0.0, 99.0], "depth.distortion[4]"),
    ("depth_to_color.rotation", [[2, 0, 0], [0, 1, 0], [0, 0, 1]], "depth_to_color.rotation"),
    ("depth_to_color.rotation", [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "depth_to_color.rotation"),
    ("depth_to_color.rotation", [[1, 0, 0], [0, 1, 0]], "depth_to_color.rotation"),
    ("depth_to_color.rotation", [[0, 0, 0], [0, 0, 0], [0, 0, 0]], "depth_to_color.rotation"),
    ("depth_to_color.rotation", [[S, S, 0], [S, S, 0], [0, 0, 1]], "depth_to_color.rotation"),
    ("depth_to_color.translation_mm", [201.0, 0, 0], "depth_to_color.translation_mm"),
    ("depth_to_color.translation_mm", [150.0, 150.0, 0], "depth_to_color.translation_mm"),
    ("depth_to_color.translation_mm", [0.0321, 0.0, 0.0], "depth_to_color.translation_mm"),
    ("depth_to_color.translation_mm", [4.99, 0.0, 0.0], "depth_to_color.translation_mm"),
    ("color.distortion", [-1.15, 2.91, -2.48, 0.18, 0.0], "color.distortion"),
    ("depth.distortion", [-9.9, 9.9, 0.0, 0.0, -9.9], "depth.distortion"),
    ("depth_correction.scale", 0.5, "depth_correction.scale"),
    ("disparity.step_px", 0, "disparity.step_px"),
    ("depth", None, "depth"),
    ("depth", [], "depth"),
]


def changed(path, value):
    document = copy.deepcopy(GOOD)
    *parents, key = path.split(".")
    target = document
    for parent in parents:
        target = target[parent]
    target[key] = value
    return json.dumps(document).encode()


def test_a_good_calibration_survives_a_round_trip(tmp_path):
    calibration = parse_calibration(json.dumps(GOOD).encode())
    again = parse_calibration(calibration.to_json().encode())
    assert isinstance(again, Calibration)
    assert again.sha256 == calibration.sha256
    assert again.depth.fx == 570.0
    path = tmp_path / "cal.json"
    path.write_text(calibration.to_json())
    assert load_calibration(path).sha256 == calibration.sha256


@pytest.mark.parametrize(("path", "value", "field"), WRONG, ids=[f"{p}={str(v)[:24]}" for p, v, _ in WRONG])
def test_each_impossible_value_is_refused_by_name(path, value, field):
    with pytest.raises(CalibrationError) as refusal:
        parse_calibration(changed(path, value))
    assert refusal.value.field.startswith(field)
    assert refusal.value.bound


@pytest.mark.parametrize("path", ["schema", "depth.fx", "depth_to_color.rotation"])
def test_a_missing_key_is_named(path):
    document = copy.deepcopy(GOOD)
    *parents, key = path.split(".")
    target = document
    for parent in parents:
        target = target[parent]
    del target[key]
    with pytest.raises(CalibrationError) as refusal:
        parse_calibration(json.dumps(document).encode())
    assert refusal.value.field == path


@pytest.mark.parametrize("path", ["fov", "depth.fz", "depth_to_color.scale"])
def test_an_unknown_key_is_named(path):
    with pytest.raises(CalibrationError) as refusal:
        parse_calibration(changed(path, 1.0))
    assert refusal.value.field == path


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"null",
        b"[]",
        b"\xff\xfe",
        b"{" * 100_000,
        b"[" * 9 + b"]" * 9,
        b'{"schema": NaN}',
        b'{"schema": 1, "schema": 2}',
        b'{"schema": ' + b"9" * 5000 + b"}",
        b" " * (20 * 1024 * 1024),
        json.dumps(GOOD).encode()[:-1],
    ],
    ids=["empty", "null", "list", "not utf-8", "bomb", "deep", "nan", "twice", "digits", "20 MB", "cut"],
)
def test_what_is_no_such_document_is_refused(text):
    with pytest.raises(CalibrationError):
        parse_calibration(text)


@pytest.mark.parametrize("number", ["1e999", "-1e999", "Infinity", "NaN", "1" * 400])
def test_numbers_that_are_none_are_refused(number):
    text = json.dumps(GOOD).replace('"fx": 570,', f'"fx": {number},').encode()
    with pytest.raises(CalibrationError):
        parse_calibration(text)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(CalibrationError, match=r"missing\.json"):
        load_calibration(tmp_path / "missing.json")


@given(st.binary(max_size=300))
def test_any_bytes_give_a_calibration_or_a_refusal(text):
    with pytest.raises(CalibrationError):
        parse_calibration(text)


def test_the_serial_number_is_kept_and_changes_the_identity_only_where_there_is_one():
    without = parse_calibration(json.dumps(GOOD).encode())
    ours = parse_calibration(json.dumps({**GOOD, "serial": "A1"}).encode())
    assert (without.serial, ours.serial) == ("", "A1")
    assert "serial" not in without.to_json()
    assert parse_calibration(ours.to_json().encode()).serial == "A1"
    assert ours.sha256 != without.sha256
    for serial in ("", "a\nb", 7, "x" * 81):
        with pytest.raises(CalibrationError) as refused:
            parse_calibration(json.dumps({**GOOD, "serial": serial}).encode())
        assert refused.value.field == "serial"


USUAL = {
    "Xtion": [0.02, -0.11, 0.001, -0.001, 0.06],
    "Kinect": [0.2624, -0.9531, -0.0054, 0.0026, 1.1633],
    "RealSense": [-0.055, 0.065, 0.0005, -0.0003, -0.021],
    "wide": [-0.30, 0.09, 0.0002, 0.0001, -0.012],
    "strong": [0.14, -0.32, 0.0, 0.0, 0.19],
}


@pytest.mark.parametrize("name", USUAL)
def test_the_distortion_of_a_usual_lens_is_accepted(name):
    camera = parse_calibration(changed("color.distortion", USUAL[name])).color
    assert least_magnification(camera) > 0.3


@given(st.lists(st.floats(min_value=-0.5, max_value=0.5), min_size=5, max_size=5))
def test_the_least_magnification_is_that_of_opencvs_projection(distortion):
    camera = replace(parse_calibration(json.dumps(GOOD).encode()).color, distortion=tuple(distortion))
    columns, rows = np.linspace(0.0, camera.width - 1.0, 65), np.linspace(0.0, camera.height - 1.0, 65)
    x, y = np.meshgrid((columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy)

    def projected(x, y):
        points = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 1, 3)
        flat, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), np.array(distortion))
        return flat.reshape(*x.shape, 2)

    step = 1e-5
    along_x = (projected(x + step, y) - projected(x - step, y)) / (2.0 * step)
    along_y = (projected(x, y + step) - projected(x, y - step)) / (2.0 * step)
    least = (along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]).min()
    assert least_magnification(camera) == pytest.approx(least, abs=1e-5)


def test_a_calibration_of_mirrored_pictures_projects_each_point_to_the_mirrored_pixel():
    document = json.loads(changed("color.distortion", [0.1, -0.2, 0.003, -0.002, 0.05]))
    document["depth_to_color"]["rotation"] = cv2.Rodrigues(np.array([0.01, -0.02, 0.03]))[0].tolist()
    calibration = parse_calibration(json.dumps(document).encode())
    mirrored = calibration.of_mirrored_pictures()
    points = np.array([[100.0, -50.0, 900.0], [-200.0, 120.0, 1100.0]])
    for one, camera in (("depth", calibration.depth), ("color", calibration.color)):
        seen, other = (
            _projected(which, one, at) for which, at in ((calibration, points), (mirrored, points * [-1, 1, 1]))
        )
        assert np.allclose(other[:, 0], camera.width - 1.0 - seen[:, 0])
        assert np.allclose(other[:, 1], seen[:, 1])
    assert mirrored.of_mirrored_pictures().to_json() == calibration.to_json()


def _projected(calibration, name, points):
    camera = getattr(calibration, name)
    pose = calibration.color_from_depth
    rotation, shift = (pose.rotation, pose.translation_mm) if name == "color" else (np.eye(3), np.zeros(3))
    matrix = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    pixels, _ = cv2.projectPoints(points, cv2.Rodrigues(rotation)[0], shift, matrix, np.array(camera.distortion))
    return pixels.reshape(-1, 2)
