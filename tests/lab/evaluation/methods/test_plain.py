"""The plain method of the article does what the article says, step by step and as a whole."""

from dataclasses import replace

import numpy as np
import pytest

from engine.core.frames import ROI_COLUMNS, ROI_ROWS
from lab.evaluation.methods.plain import (
    Aligner,
    PlainReading,
    PlainVolume,
    cut_roi,
    fill_zeros,
    find_dots,
    principal_components,
    prism_volume_l,
    smooth,
    unfiltered,
)
from lab.phantom.builds import find_build
from lab.phantom.rig import build_rig
from tests.support.motion import small_scene

pytestmark = pytest.mark.slow

FPS = 30.0
TRAINING = 30
STRIDE = 4


@pytest.fixture(scope="module")
def learned():
    """The plain method after it has learned from 30 frames, every fourth, and its first measured frame."""
    reading = PlainReading(small_scene.CALIBRATION, FPS, training_frames=TRAINING)
    for index in range(TRAINING * STRIDE + 1):
        first = reading.measure(small_scene.frame(index))
    assert first is not None
    return reading, first


def whole_mm(reading, frame):
    return float(reading.model.reconstruct(frame.beta).mean())


def test_it_learns_from_the_articles_rate_and_measures_from_the_frame_after(learned):
    reading, _ = learned
    assert len(reading.raw_mm) == TRAINING
    before = PlainReading(small_scene.CALIBRATION, FPS, training_frames=TRAINING)
    assert before.measure(small_scene.frame(0)) is None


@pytest.mark.parametrize("index", [130, 145, 160, 175])
def test_a_known_motion_is_measured_against_the_first_measured_frame(learned, index):
    reading, first = learned
    now = reading.measure(small_scene.frame(index))
    motion = whole_mm(reading, first) - whole_mm(reading, now)
    assert abs(motion - small_scene.whole_motion_mm(index, TRAINING * STRIDE)) < 0.15


def test_inhale_is_positive_in_motion_and_volume(learned):
    reading, _ = learned
    volume = PlainVolume(small_scene.CALIBRATION)
    low, high = (
        reading.measure(small_scene.frame(at, excursion=mm)) for at, mm in ((200, (0.5, 1.0)), (201, (3.5, 9.0)))
    )
    assert whole_mm(reading, low) > whole_mm(reading, high)
    volume.above_first_l(reading.model.reconstruct(low.beta), low.dots_px)
    assert volume.above_first_l(reading.model.reconstruct(high.beta), high.dots_px) > 0.1


def test_a_hole_lies_on_the_mean_and_so_takes_motion_away_instead_of_a_metre(learned):
    reading, _ = learned

    def hole(depth):
        depth[250:330, 280:360] = 0

    whole = reading.measure(small_scene.frame(210, excursion=(3.5, 9.0), seed=1))
    holed = reading.measure(small_scene.frame(210, excursion=(3.5, 9.0), seed=1, edit=hole))
    lost = abs(whole_mm(reading, whole) - whole_mm(reading, holed))
    assert 0.05 < lost < 3.0


def test_dots_are_found_to_a_quarter_of_a_pixel_and_followed():
    dots = find_dots(small_scene.picture(), None)
    assert np.abs(dots - small_scene.CORNERS_PX).max() < 0.25
    moved = find_dots(small_scene.picture(small_scene.CORNERS_PX + 3.0), dots)
    assert np.abs(moved - small_scene.CORNERS_PX - 3.0).max() < 0.25


def test_fewer_than_four_dots_are_none():
    assert find_dots(small_scene.picture(small_scene.CORNERS_PX[:3]), None) is None


def test_every_depth_pixel_lands_where_both_cameras_see_the_same_point():
    rig = build_rig(find_build(3), 3)
    depth = np.zeros((480, 640), np.uint16)
    spots = np.array([(200, 150), (320, 240), (450, 400)])
    depth[spots[:, 1], spots[:, 0]] = 850
    aligned = Aligner(rig.calibration).align(depth)
    correction = rig.calibration.depth_correction
    true_mm = 850 * correction.scale + correction.offset_mm
    points = rig.color_from_depth.apply(rig.depth.rays(spots.astype(float)) * true_mm)
    seen = np.rint(rig.color.project(points)).astype(int)
    assert set(zip(*np.nonzero(aligned)[::-1], strict=True)) == {tuple(place) for place in seen}
    assert np.allclose(aligned[aligned > 0], true_mm, atol=0.01)


@pytest.mark.parametrize("place", [(240, 320), (240, 321), (241, 320), (241, 321)])
def test_the_nearest_of_the_points_in_a_pixel_hides_the_others(place):
    coarse = replace(small_scene.CAMERA, fx=275.0, fy=275.0)
    depth = np.full((480, 640), 900, np.uint16)
    depth[place] = 600
    aligned = Aligner(replace(small_scene.CALIBRATION, color=coarse)).align(depth)
    assert (aligned == 600).sum() == 1


def test_the_corners_of_the_region_are_the_dots():
    aligned = np.zeros((480, 640), np.float32)
    for value, (x, y) in enumerate(small_scene.CORNERS_PX, start=1):
        aligned[int(y), int(x)] = value
    roi = cut_roi(aligned, small_scene.CORNERS_PX)
    assert [roi[0, 0], roi[0, -1], roi[-1, -1], roi[-1, 0]] == [1, 2, 3, 4]


def test_a_zero_takes_the_mode_of_its_neighbours_and_a_large_hole_stays():
    depth = np.full((40, 40), 800, np.float32)
    depth[10, 9:12] = (790, 0, 790)
    depth[20:38, 5:25] = 0
    filled = fill_zeros(depth)
    assert filled[10, 10] == 800
    assert filled[29, 15] == 0
    assert (filled[depth > 0] == depth[depth > 0]).all()


def test_the_bilateral_filter_takes_noise_away_and_leaves_steps():
    rng = np.random.default_rng(1)
    step = np.where(np.arange(60) < 30, 800.0, 860.0)[None].repeat(60, axis=0)
    noisy = (step + rng.normal(0.0, 1.0, step.shape)).astype(np.float32)
    assert np.std(smooth(noisy) - step) < 0.5
    assert abs(float(smooth(noisy)[:, 29].mean()) - 800.0) < 1.0


def test_the_mean_is_subtracted_whatever_equation_3_prints():
    rng = np.random.default_rng(2)
    shape = rng.standard_normal(ROI_ROWS * ROI_COLUMNS)
    weights = rng.normal(0.0, 5.0, 40)
    data = (850.0 + weights[:, None] * shape).astype(np.float32)
    model = principal_components(data)
    assert np.allclose(model.mean_mm, data.mean(axis=0), atol=1e-3)
    assert model.eigenvalues_mm2[0] / model.eigenvalues_mm2.sum() > 0.999
    assert model.eigenvalues_mm2[0] == pytest.approx(np.var(weights, ddof=1) * (shape @ shape), rel=1e-3)
    assert np.allclose(np.linalg.norm(model.components[0]), 1.0, atol=1e-4)
    rebuilt = model.reconstruct(model.project(data[7].reshape(ROI_ROWS, ROI_COLUMNS)), 1)
    assert np.abs(rebuilt.ravel() - data[7]).max() < 0.05


def test_without_filtering_the_strongest_component_is_where_holes_come_and_go(learned):
    reading, _ = learned
    frames = [raw.copy() for raw in reading.raw_mm]
    for frame in frames[::2]:
        frame[50:70, 50:70] = 0
    component = np.abs(unfiltered(frames).components[0].reshape(ROI_ROWS, ROI_COLUMNS))
    assert component[50:70, 50:70].mean() > 20.0 * component[200:300, 50:150].mean()


@pytest.mark.parametrize("plane_mm", [850.0, 805.0])
def test_three_tetrahedra_make_a_prism(plane_mm):
    rng = np.random.default_rng(3)
    corners = rng.uniform(-50.0, 50.0, (20, 3, 3))
    corners[:, :, 2] += 800.0
    a, b, c = (corners[:, i] for i in range(3))
    area = 0.5 * ((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
    expected = (area * (plane_mm - corners[:, :, 2].mean(axis=1))).sum() * 1e-6
    assert prism_volume_l(corners, plane_mm) == pytest.approx(expected, abs=1e-9)
