"""Both cameras and their pose come back from what they saw; outliers are named, what teaches too little is refused."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from engine.calibration.procedures.accuracy import AT_MM
from engine.calibration.procedures.boards import find_coverage
from engine.calibration.procedures.checkerboard import FoundBoards, calibrate
from engine.calibration.procedures.stereo_pair import BoardPair, PictureSizes, fit_pair
from engine.core.errors import CalibrationError, InvalidValueError
from service.cli.calibrate.residuals import draw_residuals
from tests.support.calibration.camera_pair import BOARD, CAMERAS, board_poses, seen_corners

pytestmark = [pytest.mark.slow, pytest.mark.verification]

SIZES = PictureSizes(depth=(640, 480), color=(640, 480))
NOISE_PX = 0.05


def make_pairs(count=16, *, seed=1, noise_px=NOISE_PX, tilt_deg=32.0):
    rng = np.random.default_rng(seed)
    pairs = []
    for i, pose in enumerate(board_poses(count, seed=seed, tilt_deg=tilt_deg)):
        depth, color = (corners + rng.normal(0.0, noise_px, corners.shape) for corners in seen_corners(pose))
        pairs.append(BoardPair(name=f"pose{i:02d}", depth_px=depth, color_px=color))
    return pairs


def alignment_errors_mm(calibration):
    """How far depth pixels at 850 mm land from where they belong in the colour picture."""
    grid = np.stack(np.meshgrid(np.linspace(128, 512, 7), np.linspace(96, 384, 7)), axis=-1).reshape(-1, 2)
    mapped = [
        cameras.color.project(
            cameras.color_from_depth.apply(CAMERAS.depth.rays(grid) * 0 + cameras.depth.rays(grid) * AT_MM)
        )
        for cameras in (calibration, CAMERAS)
    ]
    return np.linalg.norm(mapped[0] - mapped[1], axis=1) * AT_MM / CAMERAS.color.fx


def moved_apart(pair):
    """The board was moved between the two pictures."""
    return replace(pair, color_px=pair.color_px + np.array([2.0, -1.0]))


def assert_the_same(mine, other):
    for one, two in ((mine.depth, other.depth), (mine.color, other.color)):
        np.testing.assert_allclose(one.matrix, two.matrix, rtol=0, atol=2e-3)
    np.testing.assert_allclose(
        mine.color_from_depth.translation_mm, other.color_from_depth.translation_mm, rtol=0, atol=2e-3
    )


@pytest.fixture(scope="module")
def plain():
    return calibrate(BOARD, found(make_pairs()), camera="bench")


def found(pairs):
    return FoundBoards(pairs=tuple(pairs), sizes=SIZES, unseen={})


def test_without_noise_the_cameras_come_back_exactly():
    made = calibrate(BOARD, found(make_pairs(noise_px=0.0)), camera="bench").calibration
    for mine, true in ((made.depth, CAMERAS.depth), (made.color, CAMERAS.color)):
        np.testing.assert_allclose(mine.matrix, true.matrix, rtol=0, atol=0.02)
        np.testing.assert_allclose(mine.distortion, true.distortion, rtol=0, atol=2e-3)
    pose = made.color_from_depth
    np.testing.assert_allclose(pose.rotation, CAMERAS.color_from_depth.rotation, rtol=0, atol=2e-5)
    np.testing.assert_allclose(pose.translation_mm, CAMERAS.color_from_depth.translation_mm, rtol=0, atol=0.02)


@pytest.mark.parametrize("seed", [1, 2])
def test_with_noise_they_come_back_within_what_is_stated(seed):
    result = calibrate(BOARD, found(make_pairs(seed=seed)), camera="bench")
    errors_mm = alignment_errors_mm(result.calibration)
    said = result.accuracy
    assert np.sqrt(np.square(errors_mm).mean()) < 3.0 * said.alignment_mm
    assert said.alignment_mm < 0.1
    assert said.residual_px == pytest.approx(NOISE_PX * np.sqrt(2.0), rel=0.15)
    assert said.residual_mm == pytest.approx(said.residual_px * AT_MM / 527.9, rel=0.01)
    assert abs(result.calibration.depth.fx / CAMERAS.depth.fx - 1.0) * 100.0 < 4.0 * said.scale_mm
    assert result.fit.outliers == {}


def test_what_is_stated_of_the_accuracy_holds_in_the_mean():
    """Root mean square error over several sets of pictures, against the root mean square of what was said."""
    results = [calibrate(BOARD, found(make_pairs(seed=seed)), camera="bench") for seed in range(10, 14)]
    true_mm = np.sqrt(np.mean([np.square(alignment_errors_mm(result.calibration)).mean() for result in results]))
    said_mm = np.sqrt(np.mean([result.accuracy.alignment_mm**2 for result in results]))
    assert 0.5 < true_mm / said_mm < 1.4


def test_a_board_that_was_found_the_other_way_round_is_turned(plain):
    pairs = [replace(pair, color_px=pair.color_px[::-1]) if i % 2 else pair for i, pair in enumerate(make_pairs())]
    assert_the_same(calibrate(BOARD, found(pairs), camera="bench").calibration, plain.calibration)


def test_a_board_that_moved_between_the_two_pictures_is_left_out_by_name():
    pairs = make_pairs()
    moved = [moved_apart(pair) if pair.name == "pose05" else pair for pair in pairs]
    result = calibrate(BOARD, found(moved), camera="bench")
    assert list(result.fit.outliers) == ["pose05"]
    assert "two pictures together" in result.fit.outliers["pose05"]
    without = calibrate(BOARD, found([pair for pair in pairs if pair.name != "pose05"]), camera="bench")
    assert_the_same(result.calibration, without.calibration)
    assert result.report()["outliers"].keys() == {"pose05"}
    assert len(result.report()["pictures"]) == 15


def test_a_picture_with_blurred_corners_is_left_out_by_name():
    pairs = make_pairs()
    rng = np.random.default_rng(5)
    blurred = replace(pairs[3], depth_px=pairs[3].depth_px + rng.normal(0.0, 0.6, pairs[3].depth_px.shape))
    outliers = calibrate(BOARD, found([*pairs[:3], blurred, *pairs[4:]]), camera="bench").fit.outliers
    assert list(outliers) == ["pose03"]
    assert "infrared" in outliers["pose03"]


def test_too_few_pictures_are_refused():
    with pytest.raises(CalibrationError, match=r"5 pairs.*at least 6 pairs"):
        fit_pair(BOARD, make_pairs(5), SIZES)


def test_boards_that_were_never_tilted_are_refused():
    with pytest.raises(CalibrationError, match=r"tilted by .* degrees at most"):
        fit_pair(BOARD, make_pairs(tilt_deg=5.0), SIZES)


def test_a_focal_length_that_is_hardly_known_is_refused():
    with pytest.raises(CalibrationError) as refusal:
        fit_pair(BOARD, make_pairs(7, tilt_deg=18.0, noise_px=0.5), SIZES)
    assert refusal.value.field in {"depth.fx", "color.fx"}
    assert "tilt the board more" in refusal.value.bound


def test_cameras_that_do_not_look_the_same_way_up_are_refused():
    quarter = [
        replace(pair, color_px=np.column_stack([480 - pair.color_px[:, 1], pair.color_px[:, 0]]))
        for pair in make_pairs()
    ]
    with pytest.raises(CalibrationError, match="same way up"):
        fit_pair(BOARD, quarter, SIZES)


def test_the_infrared_picture_s_offset_moves_the_depth_camera_s_centre(plain):
    moved = calibrate(BOARD, found(make_pairs()), camera="bench", infrared_offset_px=(-4.0, -3.0)).calibration
    assert (moved.depth.cx, moved.depth.cy) == pytest.approx(
        (plain.calibration.depth.cx - 4.0, plain.calibration.depth.cy - 3.0)
    )
    assert moved.color == plain.calibration.color
    with pytest.raises(InvalidValueError):
        calibrate(BOARD, found(make_pairs()), camera="bench", infrared_offset_px=(21.0, 0.0))


def test_places_without_corners_are_named():
    corners = np.stack(np.meshgrid(np.arange(5, 400, 20.0), np.arange(5, 480, 20.0)), axis=-1)
    coverage = find_coverage(corners, (640, 480))
    assert coverage.empty_places == ("upper right", "central right", "lower right")
    assert coverage.share == pytest.approx(5 / 8)


def test_the_picture_of_the_residuals_is_one():
    pairs = make_pairs()
    pairs[5] = moved_apart(pairs[5])
    result = calibrate(BOARD, found(pairs), camera="bench")
    picture = cv2.imdecode(np.frombuffer(draw_residuals(result), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape[0] > 500
    assert picture.shape[1] > 1000
    red = (picture[..., 2] > 120) & (picture[..., 1] < 60) & (picture[..., 0] < 60)
    assert np.count_nonzero(red[500:]) > 100, "the outlier is written in red"
