"""A calibration that cannot be true is refused with the field, the value and the bound."""

import copy
import json

import numpy as np
import pytest
from hypothesis import given, strategies as st

from engine.calibration.camera_calibration import Calibration, load_calibration, parse_calibration
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
