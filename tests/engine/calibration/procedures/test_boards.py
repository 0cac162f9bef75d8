"""Corners are found where they are, in pictures as infrared and colour cameras give them."""

import cv2
import numpy as np
import pytest

from engine.calibration.procedures.boards import Board, find_corners, list_pictures, match_pictures, read_picture
from engine.core.errors import InvalidValueError, RecordingError
from tests.support.calibration.camera_pair import BOARD, CAMERAS, board_poses, draw, seen_corners

pytestmark = pytest.mark.slow


def corner_errors(picture, pose):
    corners = find_corners(picture, BOARD)
    true, _ = seen_corners(pose)
    either = [corners - true, corners[::-1] - true]
    return min(either, key=lambda errors: np.abs(errors).max())


def test_corners_are_found_to_a_twentieth_of_a_pixel():
    errors = np.concatenate(
        [corner_errors(draw(CAMERAS.depth, pose, seed=i), pose) for i, pose in enumerate(board_poses(4))]
    )
    assert np.sqrt(np.square(errors).mean()) < 0.05
    assert np.abs(errors.mean(axis=0)).max() < 0.02


def test_a_dark_sixteen_bit_picture_is_stretched(tmp_path):
    pose = board_poses(1)[0]
    dark = (draw(CAMERAS.depth, pose).astype(np.uint16) // 2 + 3).astype(np.uint16)
    path = tmp_path / "ir.png"
    cv2.imwrite(str(path), dark)
    picture = read_picture(path)
    assert (picture.dtype, picture.min(), picture.max()) == (np.uint8, 0, 255)
    assert np.sqrt(np.square(corner_errors(picture, pose)).mean()) < 0.08


def test_a_board_that_is_cut_off_or_another_one_is_not_found():
    picture = draw(CAMERAS.depth, board_poses(1)[0])
    true, _ = seen_corners(board_poses(1)[0])
    cut = picture.copy()
    cut[:, : int(true[:, 0].mean())] = 90
    assert find_corners(cut, BOARD) is None
    assert find_corners(picture, Board(columns=11, rows=8, square_mm=30.0)) is None
    assert find_corners(np.full((480, 640), 90, np.uint8), BOARD) is None


@pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n" + b"\0" * 40])
def test_what_is_no_picture_is_refused_by_name(tmp_path, content):
    path = tmp_path / "a.png"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match=r"^a\.png is no picture"):
        read_picture(path)


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"columns": 2}, "columns"),
        ({"rows": 41}, "rows"),
        ({"rows": 9}, "rows"),
        ({"square_mm": 0.0}, "square_mm"),
        ({"square_mm": float("nan")}, "square_mm"),
    ],
)
def test_what_is_no_board_is_refused(values, field):
    with pytest.raises(InvalidValueError) as refusal:
        Board(**({"columns": 9, "rows": 6, "square_mm": 30.0} | values))
    assert refusal.value.field == field


def touch(folder, *names):
    folder.mkdir(exist_ok=True)
    for name in names:
        (folder / name).write_bytes(b"")
    return folder


def test_pictures_of_one_name_belong_together_and_the_rest_is_named(tmp_path):
    depth = touch(tmp_path / "d", "b.png", "a.png", "only.png", "notes.txt")
    color = touch(tmp_path / "c", "a.jpg", "b.jpg")
    pairs, unpaired = match_pictures(list_pictures("d", str(depth)), list_pictures("c", f"{color}/*.jpg"))
    assert [(one.name, other.name) for one, other in pairs] == [("a.png", "a.jpg"), ("b.png", "b.jpg")]
    assert unpaired == ["only.png"]


def test_pictures_of_other_names_belong_together_by_their_order(tmp_path):
    depth, color = touch(tmp_path / "d", "ir2.png", "ir1.png"), touch(tmp_path / "c", "rgb1.png", "rgb2.png")
    pairs, unpaired = match_pictures(list_pictures("d", str(depth)), list_pictures("c", str(color)))
    assert [(one.name, other.name) for one, other in pairs] == [("ir1.png", "rgb1.png"), ("ir2.png", "rgb2.png")]
    assert unpaired == []


def test_another_number_of_pictures_with_other_names_is_refused(tmp_path):
    depth, color = touch(tmp_path / "d", "ir2.png", "ir1.png"), touch(tmp_path / "c", "rgb1.png")
    with pytest.raises(InvalidValueError) as refusal:
        match_pictures(list_pictures("d", str(depth)), list_pictures("c", str(color)))
    assert refusal.value.field == "color-pictures"
    with pytest.raises(InvalidValueError) as refusal:
        list_pictures("depth-pictures", str(tmp_path / "nothing"))
    assert refusal.value.field == "depth-pictures"
