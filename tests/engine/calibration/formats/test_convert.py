"""Calibrations of OpenCV and ROS become ours exactly, or are refused by the name of what is missing or ambiguous."""

import contextlib
import json

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from engine.calibration.camera_calibration import SCHEMA
from engine.calibration.formats.builder import ImportOptions
from engine.calibration.formats.conversion import convert, read_upload
from engine.core.errors import CalibrationError
from tests.support.calibration.foreign_calibrations import (
    CAMERAS,
    SIZES,
    TURN,
    as_yaml,
    camera_info,
    echoed,
    import_document,
    ros_pair,
    storage_values,
    write_storage,
)

pytestmark = pytest.mark.slow

NAMED = {"camera": "bench 7", "first_camera": "depth"}


def assert_the_same(calibration, expected=CAMERAS):
    for mine, theirs in ((calibration.depth, expected.depth), (calibration.color, expected.color)):
        assert (mine.width, mine.height) == (theirs.width, theirs.height)
        np.testing.assert_allclose(mine.matrix, theirs.matrix, rtol=0, atol=1e-9)
        np.testing.assert_allclose(mine.distortion, theirs.distortion, rtol=0, atol=1e-12)
    pose = calibration.color_from_depth
    np.testing.assert_allclose(pose.rotation, expected.color_from_depth.rotation, rtol=0, atol=1e-9)
    np.testing.assert_allclose(pose.translation_mm, expected.color_from_depth.translation_mm, rtol=0, atol=1e-9)


def refusal_of(files, **options):
    with pytest.raises(CalibrationError) as refusal:
        convert(files, ImportOptions(**options))
    assert refusal.value.bound
    return refusal.value


# OpenCV FileStorage


@pytest.mark.parametrize("suffix", ["yml", "xml", "json"])
def test_what_opencv_writes_becomes_the_same_cameras(tmp_path, suffix):
    text = write_storage(tmp_path / f"stereo.{suffix}", storage_values() | NAMED)
    converted = convert([text], ImportOptions())
    assert converted.format == "opencv-filestorage"
    assert converted.calibration.camera == "bench 7"
    assert_the_same(converted.calibration)


def test_the_two_files_of_the_stereo_sample_are_read_together(tmp_path):
    values = storage_values()
    cameras = {name: values[name] for name in ("M1", "D1", "M2", "D2")}
    pose = {name: values[name] for name in ("R", "T")} | {name: np.eye(3, 4) for name in ("P1", "P2", "Q", "R1")}
    files = [write_storage(tmp_path / "in.yml", cameras | SIZES), write_storage(tmp_path / "ex.yml", pose)]
    assert_the_same(convert(files, ImportOptions(**NAMED)).calibration)


def test_the_head_that_older_opencv_writes_is_read(tmp_path):
    text = write_storage(tmp_path / "a.yml", storage_values() | NAMED)
    assert text.startswith(b"%YAML")
    old = b"%YAML:1.0" + text[text.index(b"\n") :]
    assert_the_same(convert([old], ImportOptions()).calibration)


def test_a_pose_from_colour_to_depth_is_turned_round(tmp_path):
    text = write_storage(tmp_path / "a.yml", storage_values(first="color"))
    converted = convert([text], ImportOptions(camera="x", first_camera="color"))
    assert_the_same(converted.calibration)
    assert any("turned round" in note for note in converted.notes)


def test_names_that_say_which_camera_need_no_more(tmp_path):
    values = storage_values()
    names = {"M1": "depth_camera_matrix", "D1": "depth_distortion", "M2": "color_camera_matrix"}
    names |= {"D2": "color_distortion_coefficients", "R": "rotation", "T": "translation"}
    text = write_storage(tmp_path / "a.yml", {names.get(key, key): value for key, value in values.items()})
    assert_the_same(convert([text], ImportOptions(camera="x")).calibration)


@pytest.mark.parametrize("unit", ["m", None])
def test_metres_are_converted(tmp_path, unit):
    text = write_storage(tmp_path / "a.yml", storage_values(unit_mm=1000.0) | NAMED)
    converted = convert([text], ImportOptions(translation_unit=unit))
    assert_the_same(converted.calibration)
    assert any("metres" in note for note in converted.notes) == (unit is None)


@pytest.mark.parametrize("unit_mm", [25.0, 10.0, 0.1, 1e9], ids=["squares", "cm", "tenths", "nothing"])
def test_a_translation_that_could_be_anything_is_asked_for(tmp_path, unit_mm):
    refusal = refusal_of([write_storage(tmp_path / "a.yml", storage_values(unit_mm=unit_mm) | NAMED)])
    assert refusal.field == "T"
    assert "translation_unit" in refusal.bound


AMBIGUOUS = [
    ({"first_camera": ...}, "first_camera"),
    ({"first_camera": "left"}, "first_camera"),
    ({"camera": ...}, "camera"),
    ({"M2": ...}, "M2"),
    ({"D1": ...}, "D1"),
    ({"T": ...}, "T"),
    ({"color_image_width": ...}, "color_image_width"),
    ({"image_width": 640}, "image_width"),
    ({"depth_camera_matrix": np.eye(3)}, "depth_camera_matrix"),
    ({"rotation": np.eye(3)}, "rotation"),
    ({"translation_unit": "inch"}, "translation_unit"),
    ({"surprise": 1}, "surprise"),
    ({"M1": np.array([[500.0, 3.0, 320.0], [0, 500.0, 240.0], [0, 0, 1]])}, "M1"),
    ({"M1": np.eye(4)}, "M1"),
    ({"M1": np.array([[9e5, 0, 320.0], [0, 9e5, 240.0], [0, 0, 1]])}, "M1[0][0]"),
    ({"D2": np.zeros((1, 6))}, "D2"),
    ({"D2": np.array([[0.1, 0, 0, 0, 0, 0.5, 0, 0]])}, "D2[5]"),
    ({"D2": np.array([[0.1, 0, 99.0, 0, 0]])}, "D2[2]"),
    ({"R": np.diag([1.0, 1.0, -1.0])}, "R"),
    ({"T": np.array([[190.0], [190.0], [0.0]]), "translation_unit": "mm"}, "T"),
    ({"depth_image_width": 0.5}, "depth_image_width"),
    ({"M1": "570 570 320 240"}, "M1"),
]


@pytest.mark.parametrize(("change", "field"), AMBIGUOUS, ids=lambda part: str(part)[:40].replace("\n", ""))
def test_what_is_missing_ambiguous_or_impossible_is_refused_by_the_name_in_the_file(tmp_path, change, field):
    values = storage_values() | NAMED | change
    kept = {name: value for name, value in values.items() if value is not ...}
    assert refusal_of([write_storage(tmp_path / "a.yml", kept)]).field == field


def test_the_same_key_in_two_files_is_refused(tmp_path):
    text = write_storage(tmp_path / "a.yml", storage_values() | NAMED)
    assert refusal_of([text, text]).value == "'given in two files'"


# ROS camera_info


def test_a_rectified_ros_pair_becomes_the_same_cameras():
    converted = convert(ros_pair(), ImportOptions(camera="bench 7"))
    assert converted.format == "ros-camera-info"
    pose = converted.calibration.color_from_depth
    np.testing.assert_allclose(pose.rotation, TURN, atol=1e-12)
    np.testing.assert_allclose(pose.translation_mm, TURN @ [25.0, 0.0, 0.0], atol=1e-9)
    assert converted.calibration.depth.distortion == CAMERAS.depth.distortion


def test_a_point_seen_by_both_rectified_cameras_lies_where_ros_states():
    """The projection matrices of ROS and our pose agree on a point in the room."""
    pose = convert(ros_pair(), ImportOptions()).calibration.color_from_depth
    point = np.array([[40.0, -70.0, 850.0]])
    rectified = (pose.apply(point) @ TURN)[0]  # the colour camera's R is TURN transposed
    depth_rectified = point[0]
    color = CAMERAS.color
    by_ros = color.fx * depth_rectified[0] / 1000 + color.cx * depth_rectified[2] / 1000 + 0.025 * color.fx
    by_us = color.fx * rectified[0] / 1000 + color.cx * rectified[2] / 1000
    assert by_us == pytest.approx(by_ros, abs=1e-9)


def test_the_order_of_the_files_does_not_matter_when_their_names_tell():
    one, two = ros_pair()
    shas = [convert(files, ImportOptions()).calibration.sha256 for files in ([one, two], [two, one])]
    assert shas[0] == shas[1]


@pytest.mark.parametrize("is_lower", [False, True])
def test_an_echoed_message_is_read_alike(is_lower):
    documents = [camera_info(CAMERAS.depth, "ir_frame"), camera_info(CAMERAS.color, "rgb_frame", shift_m=0.025)]
    messages = [echoed(document) for document in documents]
    if is_lower:
        messages = [{k.lower() if len(k) == 1 else k: v for k, v in message.items()} for message in messages]
    files = [as_yaml(message) + b"---\n" for message in messages]
    converted = convert(files, ImportOptions()).calibration
    stored = convert([as_yaml(document) for document in documents], ImportOptions()).calibration
    assert converted.depth == stored.depth
    assert converted.color_from_depth.rotation.tolist() == stored.color_from_depth.rotation.tolist()
    np.testing.assert_allclose(stored.color_from_depth.translation_mm, [25.0, 0.0, 0.0], atol=1e-12)


def plain_pair(**color_changes):
    color = camera_info(CAMERAS.color, "rgb") | color_changes
    return [as_yaml(camera_info(CAMERAS.depth, "depth")), as_yaml(color)]


def test_without_a_pose_in_the_files_it_has_to_be_given():
    refusal = refusal_of(plain_pair())
    assert refusal.field == "files[1].projection_matrix"
    assert "baseline_mm" in refusal.bound
    converted = convert(plain_pair(), ImportOptions(baseline_mm=24.5))
    assert converted.calibration.color_from_depth.translation_mm.tolist() == [24.5, 0.0, 0.0]
    assert any("without rotation" in note for note in converted.notes)
    pose = {"rotation": TURN.tolist(), "translation_mm": [24.0, 1.0, 0.0]}
    given = convert(plain_pair(), ImportOptions(depth_to_color=pose)).calibration.color_from_depth
    np.testing.assert_array_equal(given.rotation, TURN)


def test_a_baseline_beside_one_in_the_files_is_refused():
    assert refusal_of(ros_pair(), baseline_mm=25.0).field == "baseline_mm"


def test_a_baseline_alone_beside_rectified_cameras_is_refused():
    turned = camera_info(CAMERAS.color, "rgb", turn=TURN)
    refusal = refusal_of([plain_pair()[0], as_yaml(turned)], baseline_mm=25.0)
    assert refusal.field == "baseline_mm"
    assert "depth_to_color" in refusal.bound


def test_names_that_do_not_tell_the_cameras_apart_are_asked_for():
    color = camera_info(CAMERAS.color, "camera_2", shift_m=0.025)
    pair = [as_yaml(camera_info(CAMERAS.depth, "camera_1")), as_yaml(color)]
    assert refusal_of(pair).field == "first_camera"
    converted = convert(pair, ImportOptions(first_camera="depth"))
    assert converted.calibration.depth.width == 640
    assert refusal_of(ros_pair(), first_camera="color").field == "first_camera"


BAD_INFO = [
    ({"distortion_model": "equidistant"}, "files[1].distortion_model"),
    (
        {"distortion_coefficients": {"rows": 1, "cols": 8, "data": [0] * 7 + [0.1]}},
        "distortion_coefficients",
    ),
    ({"camera_matrix": {"rows": 3, "cols": 3, "data": [1] * 8}}, "camera_matrix.data"),
    ({"camera_matrix": {"rows": -3, "cols": -3, "data": [1] * 9}}, "camera_matrix.data"),
    ({"image_width": "wide"}, "image_width"),
    ({"image_width": 0}, "image_width"),
    ({"image_width": ".inf"}, "image_width"),
    ({"zoom": 2}, "zoom"),
    ({"projection_matrix": {"rows": 3, "cols": 4, "data": [1, 0, 0, -9, 0, 1, 0, 0, 0, 0, 1, 0]}}, "projection_matrix"),
]


@pytest.mark.parametrize(("change", "field"), BAD_INFO, ids=lambda part: str(part)[:50])
def test_a_bad_camera_info_is_refused_by_file_and_field(change, field):
    refusal = refusal_of(ros_pair(**change))
    assert refusal.field.startswith("files[1].")
    assert field in refusal.field


def test_a_rational_model_whose_further_terms_are_zero_is_the_plain_one():
    model = {"distortion_model": "rational_polynomial"}
    terms = {"distortion_coefficients": {"rows": 1, "cols": 8, "data": [0.1, -0.2, 0, 0, 0.01, 0, 0, 0]}}
    assert convert(ros_pair(**model, **terms), ImportOptions()).calibration.color.distortion[4] == 0.01


def test_one_camera_info_is_not_enough():
    assert refusal_of(ros_pair()[:1]).field == "files"


# Over the API


def test_a_pair_comes_in_one_document():
    converted = read_upload(import_document(plain_pair(), baseline_mm=25.0, camera="bench 7"))
    assert (converted.format, converted.calibration.camera) == ("ros-camera-info", "bench 7")


def test_two_documents_in_one_yaml_file_are_a_pair():
    assert read_upload(b"---\n".join(ros_pair())).format == "ros-camera-info"


@pytest.mark.parametrize(
    ("beside", "field"),
    [
        ({"camera": ""}, "camera"),
        ({"first_camera": "left"}, "first_camera"),
        ({"translation_unit": 1}, "translation_unit"),
        ({"image_size_px": [640]}, "image_size_px"),
        ({"image_size_px": [640, 1e9]}, "image_size_px[1]"),
        ({"baseline_mm": "25"}, "baseline_mm"),
        ({"baseline_mm": 201}, "baseline_mm"),
        ({"depth_to_color": {"rotation": []}}, "depth_to_color.translation_mm"),
        ({"depth_to_color": {"rotation": [], "translation_mm": []}}, "depth_to_color.rotation"),
        ({"more": 1}, "more"),
    ],
)
def test_what_is_stated_beside_the_files_is_checked(beside, field):
    with pytest.raises(CalibrationError) as refusal:
        read_upload(import_document(plain_pair(), **beside))
    assert refusal.value.field == field


def test_our_own_document_is_read_as_before_and_takes_nothing_beside():
    ours = CAMERAS.to_json().encode()
    converted = read_upload(ours)
    assert (converted.format, converted.calibration.sha256) == (SCHEMA, CAMERAS.sha256)
    assert refusal_of([ours], baseline_mm=25.0).field == "baseline_mm"
    assert refusal_of([ours, ours]).field == "files"


# Hostile


BOMB = b"a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n"


@pytest.mark.parametrize(
    "text",
    [
        b"",
        b"null",
        b"[]",
        b"{",
        b"\xff\xfe",
        b"%YAML:1.0\n---\n",
        BOMB,
        b"M1: &m 3\n",
        b"[" * 60_000,
        b"- " * 20_000,
        b"{" * 60_000,
        b"<a>" * 10_000,
        b'<!DOCTYPE x [<!ENTITY a "aaaa">]><opencv_storage><M1>&a;</M1></opencv_storage>',
        b"<opencv_storage><M1>1</M1><M1>2</M1></opencv_storage>",
        b"<opencv_storage>",
        b"M1: 1\nM1: 2\n",
        b'a: "\\UFFFFFFFF"\n',
        b"!!python/object/apply:os.system [id]",
        b"? [a, b]\n: 3\n",
        b"x" * 70_000,
        b'"M1": !!opencv-matrix {rows: 1000000, cols: 1000000, dt: d, data: [1]}',
    ],
    ids=lambda text: str(text[:30]),
)
def test_what_is_no_calibration_is_refused(text):
    with pytest.raises(CalibrationError) as refusal:
        read_upload(text)
    assert len(str(refusal.value)) < 700


def test_a_reference_in_a_good_file_is_refused_as_such():
    text = as_yaml(camera_info(CAMERAS.depth, "depth"))
    for change in (b"image_width: *w", b"image_width: &w 640"):
        refusal = refusal_of([text.replace(b"image_width: 640", change), ros_pair()[1]])
        assert (refusal.field, refusal.bound) == ("file", "without aliases and anchors")


def test_a_document_type_in_a_good_file_is_refused_as_such():
    text = STORAGES["xml"].replace(b"<opencv_storage>", b'<!DOCTYPE a [<!ENTITY b "640">]><opencv_storage>', 1)
    assert refusal_of([text.replace(b">640<", b">&b;<")]).bound == "XML without a document type"


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_any_bytes_are_refused(text):
    with pytest.raises(CalibrationError):
        read_upload(text)


PIECES = [b"&a ", b"*a", b"\n", b": ", b"1e999", b"-"]
TEXTS = [*ros_pair(), CAMERAS.to_json().encode(), import_document(plain_pair(), baseline_mm=25.0)]


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_damaged_files_give_a_calibration_or_a_refusal(tmp_path_factory, data):
    storages = [STORAGES[suffix] for suffix in ("yml", "xml", "json")]
    text = bytearray(data.draw(st.sampled_from(TEXTS + storages)))
    for _ in range(data.draw(st.integers(1, 6))):
        at = data.draw(st.integers(0, len(text) - 1))
        piece = data.draw(st.one_of(st.binary(max_size=4), st.sampled_from(PIECES)))
        text[at : at + data.draw(st.integers(0, 8))] = piece
    with contextlib.suppress(CalibrationError):
        assert json.loads(read_upload(bytes(text)).calibration.to_json())["schema"] == SCHEMA


@pytest.fixture(scope="module", autouse=True)
def _storages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("storages")
    for suffix in ("yml", "xml", "json"):
        STORAGES[suffix] = write_storage(folder / f"a.{suffix}", storage_values() | NAMED)


STORAGES: dict[str, bytes] = {}
