"""The sensor against what was measured on three real recordings, all of it at once."""

import numpy as np
import pytest

from lab.phantom.builds import find_build
from lab.phantom.rig import build_rig
from lab.phantom.sensor import Sensor, Unit, cast_shadow, depth_table_mm, shift_of
from lab.phantom.studio import Studio

pytestmark = pytest.mark.slow

FRAMES = 40
TABLE_MM = depth_table_mm()
SHIFT_OF_MM = np.full(10_001, -1)
SHIFT_OF_MM[TABLE_MM] = np.arange(2048)


class Still:
    """Many frames of a scene that does not move, as depth, as shifts, and their noise."""

    def __init__(self, studio: Studio, volunteer: int) -> None:
        scene = studio.scene
        pose = scene.timeline.pose(0.5)
        depth = studio.true_depth(0.5)
        holes = studio._depth_stage(pose).holes
        sensor = Sensor(Unit.of(scene.anatomy.build), 77 + volunteer)
        self.true_mm = depth
        self.depth_mm = np.stack([sensor.read(depth, holes, frame=i, time_s=0.5) for i in range(FRAMES)])
        self.is_read = self.depth_mm > 0
        self.shift = SHIFT_OF_MM[self.depth_mm]
        self.steps = np.diff(self.shift, axis=0)[self.is_read[1:] & self.is_read[:-1]]

    def noise(self, part):
        """Shifts of a part around each pixel's own middle, without jumps; and which of its pixels always read."""
        shift, always = self.shift[part], self.is_read[part].all(axis=0)
        away = shift - np.median(shift, axis=0)
        noise = np.where(always & (np.abs(away) < 8), away, 0.0)
        return noise - noise.mean(axis=0), always


@pytest.fixture(scope="module", params=[1, 7])
def still(request, studio):
    return Still(studio("regular", request.param), request.param)


TRUNK = np.s_[:, 180:340, 290:390]
COUCH = np.s_[:, 40:104, 214:278]


def test_every_reading_is_a_step_of_the_shift_table():
    assert TABLE_MM[684] == 849
    assert np.all(np.diff(TABLE_MM[600:1000].astype(int)) > 0)
    m = ((700 - 800) / 4 - 0.375) * 0.1052
    assert TABLE_MM[700] == int(10 * (m * 120 / (7.5 - m) + 120))
    assert shift_of(np.array([850.5])) == pytest.approx([684.5], abs=0.5)


def test_readings_lie_on_the_table_and_nowhere_between(still):
    assert set(np.unique(still.depth_mm)) <= set(TABLE_MM.tolist())


@pytest.mark.parametrize(("depth_mm", "step_mm"), [(600, 1), (800, 2), (1000, 3), (1200, 4.5), (2000, 11.5)])
def test_steps_grow_with_depth_as_measured(depth_mm, step_mm):
    near = TABLE_MM[np.abs(TABLE_MM.astype(int) - depth_mm) < 60].astype(float)
    assert np.diff(np.unique(near)).mean() == pytest.approx(step_mm, abs=0.6)


def test_noise_is_under_half_a_shift_at_any_depth(still):
    for part in (TRUNK, COUCH, np.s_[:, 250:400, 40:120]):
        noise, always = still.noise(part)
        assert 0.41 <= np.sqrt(noise.var(axis=0)[always].mean()) <= 0.52


def test_noise_in_mm_is_what_was_measured_at_that_depth(still):
    for part in (TRUNK, COUCH):
        depth = still.depth_mm[part][:, still.is_read[part].all(axis=0)].astype(float)
        away = depth - np.median(depth, axis=0)
        far = float(np.median(depth)) / 1000.0
        sigma = float(np.sqrt(np.where(np.abs(away) < 15, away, 0.0).var(axis=0).mean()))
        # 0.9 mm at 0.85 m, growing with the square of depth.
        assert 1.05 * far**2 <= sigma <= 1.6 * far**2


def test_most_steps_of_a_still_pixel_are_none_and_a_few_are_jumps(still):
    assert 0.55 <= np.mean(still.steps == 0) <= 0.70
    assert 0.002 <= np.mean(np.abs(still.steps) >= 8) <= 0.01


@pytest.mark.parametrize(
    ("apart_px", "low", "high"),
    [(1, 0.28, 0.75), (2, 0.12, 0.54), (4, 0.04, 0.31), (8, -0.03, 0.12), (16, -0.03, 0.03)],
)
def test_noise_is_correlated_over_a_few_pixels(still, apart_px, low, high):
    for part in (TRUNK, COUCH):
        noise, _ = still.noise(part)
        for one, other in (
            (noise[:, :, :-apart_px], noise[:, :, apart_px:]),
            (noise[:, :-apart_px], noise[:, apart_px:]),
        ):
            assert low <= (one * other).mean() / noise.var() <= high


def test_noise_is_white_in_time(still):
    noise, _ = still.noise(TRUNK)
    for lag in (1, 2, 5):
        assert abs((noise[lag:] * noise[:-lag]).mean() / noise.var()) < 0.04


def tile_means_mm(still, part, apart):
    depth = np.where(still.is_read[part], still.depth_mm[part], np.nan).astype(float)
    means = []
    for row, column in apart:
        tile = depth[:, row : row + 32, column : column + 32]
        # Only pixels that always read: a hole's edge would move the mean.
        means.append(tile[:, ~np.isnan(tile).any(axis=0)].mean(axis=1))
    return np.array(means)


def test_a_tile_of_32_px_moves_by_a_tenth_or_two_of_a_mm_a_frame(still):
    trunk = tile_means_mm(still, TRUNK, [(0, 0), (40, 0), (80, 0), (120, 0), (0, 60), (40, 60), (120, 60)])
    far = float(np.median(still.depth_mm[TRUNK])) / 1000.0
    moved = np.median(np.abs(np.diff(trunk, axis=1)), axis=1)
    assert 0.07 <= np.median(moved) <= 0.2 * max(1.0, (far / 0.9) ** 2)


def test_distant_tiles_have_nothing_in_common(still):
    tiles = tile_means_mm(still, TRUNK, [(0, 0), (64, 0), (128, 0), (0, 64), (64, 64), (128, 64)])
    correlation = np.corrcoef(np.diff(tiles, axis=1))
    others = correlation[~np.eye(len(tiles), dtype=bool)]
    assert abs(others.mean()) < 0.12
    # Chance alone gives 0.16 in this many frames.
    assert np.sqrt((others**2).mean()) < 0.27


def test_a_quarter_of_the_picture_is_holes_and_most_of_them_are_still(still):
    share = still.is_read.mean(axis=0)
    assert 0.20 <= 1.0 - still.is_read.mean() <= 0.30
    assert np.mean(share == 0.0) > 0.17
    assert 0.06 <= np.mean((share > 0.0) & (share < 1.0)) <= 0.08


def test_a_step_throws_a_shadow_as_wide_as_its_disparity_away_from_the_projector():
    depth = np.full((4, 640), 1070.0, np.float32)
    depth[:, 200:400] = 850.0
    shadow = cast_shadow(depth, 575.0)
    width = 575.0 * 75.0 * (1 / 850 - 1 / 1070)
    columns = np.flatnonzero(shadow[0])
    assert columns[-1] == 199
    assert len(columns) == columns[-1] - columns[0] + 1 == pytest.approx(width, abs=1.5)


def test_the_unit_is_off_by_per_cents_and_its_correction_undoes_most():
    for volunteer in range(1, 11):
        build = find_build(volunteer)
        correction = build_rig(build, volunteer).calibration.depth_correction
        scale, offset = Unit.of(build).reading_scale(0.0)
        reading = scale * 850.0 + offset
        left = abs(correction.scale * (reading - 0.5) + correction.offset_mm - 850.0)
        assert left < 4.0
        assert left < 0.6 * max(abs(reading - 850.0), 8.0)


def test_the_scale_drifts_while_the_unit_warms_up():
    unit = Unit(scale=1.0, offset_mm=0.0)
    readings = [unit.reading_scale(t)[0] * 850.0 for t in (0.0, 60.0, 600.0, 6000.0)]
    assert np.all(np.diff(readings) < 0.0)
    assert 0.5 < readings[0] - readings[-1] < 2.0
    assert readings[0] - readings[1] < 0.15


def test_a_frame_follows_from_its_number_and_the_seed_alone(studio):
    made = studio("regular", 1)
    first = made.depth_frame(5, 0.2)
    made.depth_frame(6, 0.23)
    assert np.array_equal(made.depth_frame(5, 0.2), first)
    assert np.mean(made.depth_frame(6, 0.2) != first) > 0.2


def test_the_mean_reading_is_the_true_depth_once_corrected(still, studio):
    inside = still.is_read[TRUNK].all(axis=0)
    mean = np.median(still.depth_mm[TRUNK].astype(float), axis=0)[inside]
    true = still.true_mm[TRUNK[1:]][inside]
    slope, offset = np.polyfit(true, mean, 1)
    assert np.std(mean - slope * true - offset) < 1.2
    volunteer = 1 if np.median(true) > 800 else 7
    correction = studio("regular", volunteer).scene.rig.calibration.depth_correction
    assert np.mean(correction.scale * mean + correction.offset_mm - true) == pytest.approx(0.0, abs=4.0)
