"""The laser beside Tidegate on a chest of one plane, where every number is known."""

from dataclasses import replace

import numpy as np
import pytest

from engine.calibration.laser_plane import LaserPlane
from engine.core.errors import InvalidValueError
from lab.evaluation.instruments.agreement import agreement, correlation
from lab.evaluation.instruments.laser import LaserGauge
from tests.support.evaluation.flat_chest import (
    CALIBRATION,
    CELL_PX,
    PERIOD_US,
    PLANE,
    TURNED_PLANE,
    Chest,
    frame,
    lost,
    measured,
    row_of,
    unmeasured,
)

pytestmark = pytest.mark.slow

FRAMES = 44


def breath(index, *, amplitude_mm=8.0, slope=0.0):
    return Chest(800.0 - amplitude_mm * np.sin(2.0 * np.pi * index / 40.0), slope)


def watch(chests, *, gauge=None, points=(), is_turned=False, spoil=lambda _, measurement: measurement):
    gauge = gauge or LaserGauge(CALIBRATION, PLANE, points=points, cell_px=CELL_PX)
    for index, chest in enumerate(chests):
        measurement = measured(index, chest, chests[0], is_turned=is_turned)
        gauge.add(frame(index, chest, is_turned=is_turned), spoil(index, measurement))
    return gauge.comparison()


def true_motion(chests):
    return np.array([chests[0].depth_mm - chest.depth_mm for chest in chests])


def off(measurement, by_mm):
    """The same measurement with Tidegate's surface nearer by some mm."""
    motion = measurement.motion
    wrong = replace(motion, regions_mm=motion.regions_mm + by_mm, regions_depth_mm=motion.regions_depth_mm - by_mm)
    return replace(measurement, motion=wrong)


def test_both_instruments_see_the_same_breath_and_inhale_is_positive():
    chests = [breath(index) for index in range(FRAMES)]
    comparison = watch(chests)
    assert comparison.laser_mm.shape == comparison.tidegate_mm.shape == (FRAMES, 5)
    assert comparison.tidegate_mm == pytest.approx(np.repeat(true_motion(chests)[:, None], 5, axis=1), abs=1e-9)
    # The last frame has no colour picture after it, but one at its very time.
    assert np.isfinite(comparison.laser_mm).all()
    assert np.abs(comparison.laser_mm - true_motion(chests)[:, None]).max() < 0.12
    assert comparison.laser_mm[10, 2] == pytest.approx(8.0, abs=0.12)
    assert abs(comparison.offset_mm) < 0.1


def test_by_default_five_points_lie_where_the_line_lay_first():
    chests = [breath(index) for index in range(FRAMES)]
    points = watch(chests).points_rc
    assert points[:, 0] == pytest.approx(row_of(chests[0].line_px), abs=0.51)
    assert points[:, 1].tolist() == [30.0, 65.0, 100.0, 134.0, 169.0]


def test_on_a_slope_the_line_slides_over_the_skin_and_the_laser_still_gives_the_point_s_motion():
    chests = [breath(index, slope=0.25) for index in range(FRAMES)]
    comparison = watch(chests)
    true = true_motion(chests)
    slid = np.ptp(comparison.place_rc[:, 2, 0])
    assert slid > 4.0
    assert np.abs(comparison.laser_mm - true[:, None]).max() < 0.2
    # The line itself went another way: it is what the article plots.
    assert np.abs(comparison.line_mm[:, 2] - true).max() > 0.25 * slid * 0.5


def test_the_error_is_that_of_equation_nine():
    chests = [breath(index, slope=0.2) for index in range(FRAMES)]
    comparison = watch(chests)
    depth_at_line = np.array([chest.at(row) for chest, row in zip(chests, comparison.place_rc[:, 2, 0], strict=True)])
    tidegate_at_line = depth_at_line[0] - depth_at_line
    equation_nine = comparison.line_mm[:, 2] - tidegate_at_line
    assert comparison.laser_mm[:, 2] - comparison.tidegate_mm[:, 2] == pytest.approx(equation_nine, abs=0.02)


def test_a_millimetre_that_tidegate_is_wrong_by_is_found_as_one():
    chests = [breath(index) for index in range(FRAMES)]
    comparison = watch(chests, spoil=lambda index, one: off(one, 1.0) if index >= 22 else one)
    difference = comparison.tidegate_mm - comparison.laser_mm
    assert np.abs(difference[:22]).max() < 0.15
    assert difference[22:] == pytest.approx(np.ones((22, 5)), abs=0.15)
    assert comparison.agreements()[0].mean_mm == pytest.approx(0.5, abs=0.1)


def test_the_laser_is_read_at_the_depth_frame_s_time_not_at_the_picture_s():
    # 20 mm/s; each colour picture is taken 14 ms after its depth frame, when the chest is 0.28 mm nearer.
    speed_mm_a_us, late_us = 20e-6, 14_000
    gauge = LaserGauge(CALIBRATION, PLANE, cell_px=CELL_PX)
    first = Chest(805.0)
    for index in range(30):
        time_us = index * PERIOD_US
        shown = Chest(805.0 - speed_mm_a_us * (time_us + late_us))
        gauge.add(
            frame(index, shown, color_us=time_us + late_us),
            measured(index, Chest(805.0 - speed_mm_a_us * time_us), first),
        )
    comparison = gauge.comparison()
    # The first depth frame has no colour picture before it.
    assert np.isnan(comparison.laser_mm[0]).all()
    assert np.abs((comparison.laser_mm - comparison.tidegate_mm)[1:]).max() < 0.15
    place = np.array([row_of(Chest(805.0 - speed_mm_a_us * index * PERIOD_US).line_px) for index in range(1, 30)])
    assert comparison.place_rc[1:, 2, 0] == pytest.approx(place, abs=0.1)


def test_on_a_slope_tidegate_s_surface_is_read_where_the_line_is_at_the_depth_frame_s_time():
    # Half a colour period off: the line slides by a good part of a row in that time, on steep skin.
    late_us, slope = PERIOD_US // 2, 0.8
    gauge = LaserGauge(CALIBRATION, PLANE, cell_px=CELL_PX)

    def chest(time_us):
        return Chest(812.0 - 60e-6 * time_us, slope)

    for index in range(12):
        time_us = index * PERIOD_US
        shown = frame(index, chest(time_us + late_us), color_us=time_us + late_us)
        gauge.add(shown, measured(index, chest(time_us), chest(0)))
    comparison = gauge.comparison()
    # What the first colour picture, half a frame before, and the first zero leave is the same in every row.
    error = (comparison.laser_mm - comparison.tidegate_mm)[1:-1]
    raw = comparison.offset_mm
    assert abs(raw) < 0.15
    assert np.abs(error).max() < 0.2


def test_where_the_line_is_hidden_nothing_is_measured_and_zero_waits_for_it():
    chests = [breath(index) for index in range(FRAMES)]
    gauge = LaserGauge(CALIBRATION, PLANE, cell_px=CELL_PX)
    for index, chest in enumerate(chests):
        is_hidden = index < 5 or 20 <= index < 25
        gauge.add(frame(index, chest, has_line=not is_hidden), measured(index, chest, chests[0]))
    comparison = gauge.comparison()
    is_seen = np.isfinite(comparison.laser_mm[:, 2])
    assert not is_seen[:5].any()
    assert not is_seen[20:25].any()
    assert is_seen[6:20].all()
    assert is_seen[26:].all()
    # The laser's zero is taken where it is first seen: there it has Tidegate's motion, not zero.
    first = int(np.flatnonzero(is_seen)[0])
    assert comparison.laser_mm[first] == pytest.approx(comparison.tidegate_mm[first])
    assert np.nanmax(np.abs(comparison.laser_mm - comparison.tidegate_mm)) < 0.2


def test_lost_frames_and_training_frames_are_rows_without_numbers():
    chests = [breath(index) for index in range(FRAMES)]
    gauge = LaserGauge(CALIBRATION, PLANE, cell_px=CELL_PX)
    for index, chest in enumerate(chests):
        one = measured(index, chest, chests[10])
        one = unmeasured(index) if index < 10 else lost(index) if 30 <= index < 34 else one
        gauge.add(frame(index, chest), one)
    comparison = gauge.comparison()
    assert comparison.frame_index.tolist() == list(range(FRAMES))
    is_there = np.isfinite(comparison.laser_mm[:, 2])
    assert is_there.tolist() == [10 <= index < 30 or index >= 34 for index in range(FRAMES)]
    assert np.isnan(comparison.tidegate_mm[:10]).all()
    assert np.isnan(comparison.tidegate_mm[30:34]).all()
    assert comparison.laser_mm[10] == pytest.approx(0.0, abs=1e-9)


def test_a_point_far_from_the_line_is_not_measured_and_the_others_are():
    chests = [breath(index) for index in range(FRAMES)]
    row = round(row_of(chests[0].line_px))
    comparison = watch(chests, points=[(row + 8, 50), (row - 80, 100)])
    near, far = comparison.agreements()
    assert near.frames == FRAMES
    assert near.mean_mm < 0.1
    assert (far.frames, far.mean_mm, far.correlation) == (0, None, None)


def test_with_the_camera_turned_the_line_is_looked_for_along_rows():
    chests = [breath(index) for index in range(FRAMES)]
    gauge = LaserGauge(CALIBRATION, TURNED_PLANE, cell_px=CELL_PX)
    comparison = watch(chests, gauge=gauge, is_turned=True)
    assert np.isfinite(comparison.laser_mm).all()
    assert np.abs(comparison.laser_mm - true_motion(chests)[:, None]).max() < 0.12


def test_another_laser_s_plane_shows_in_the_offset():
    chests = [breath(index) for index in range(FRAMES)]
    other = replace(PLANE, distance_mm=PLANE.distance_mm + 15.0)
    comparison = watch(chests, gauge=LaserGauge(CALIBRATION, other, cell_px=CELL_PX))
    assert comparison.offset_mm > 15.0


@pytest.mark.parametrize(
    ("normal", "distance_mm", "field"),
    [((0.0, 0.2, 0.98), 30.0, "plane"), ((0.0, 0.02, 0.9998), 800.0, "normal")],
)
def test_a_laser_that_hardly_leans_against_the_view_is_refused(normal, distance_mm, field):
    direction = np.array(normal) / np.linalg.norm(normal)
    plane = LaserPlane(
        camera="c", normal=direction, distance_mm=distance_mm, rms_mm=0.0, pictures=0, calibration_sha256="0" * 64
    )
    with pytest.raises(InvalidValueError) as caught:
        LaserGauge(CALIBRATION, plane)
    assert caught.value.field == field


def test_a_point_off_the_grid_is_refused():
    with pytest.raises(InvalidValueError, match=r"point is '350,0'"):
        LaserGauge(CALIBRATION, PLANE, points=[(350, 0)])


def test_a_recording_without_a_frame_gives_a_comparison_without_a_row():
    comparison = LaserGauge(CALIBRATION, PLANE).comparison()
    assert comparison.laser_mm.shape == (0, 5)
    assert [one.frames for one in comparison.agreements()] == [0] * 5


# -- the figures --------------------------------------------------------------------------------------------------


def test_figures_are_those_of_table_two():
    one = np.concatenate([np.tile([0.0, 1.0, 2.0, 3.0], 10), [np.nan, 5.0]])
    other = one + np.concatenate([np.tile([0.1, -0.3], 20), [0.0, np.nan]])
    found = agreement(one, other)
    assert found.frames == 40
    assert found.mean_mm == pytest.approx(0.2)
    assert found.deviation_mm == pytest.approx(0.1)
    assert found.largest_mm == pytest.approx(0.3)
    assert found.correlation == pytest.approx(np.corrcoef(one[:40], other[:40])[0, 1])


def test_too_few_frames_give_no_figure_and_stillness_no_correlation():
    assert agreement(np.zeros(29), np.zeros(29)).mean_mm is None
    still = agreement(np.zeros(30), np.ones(30))
    assert (still.mean_mm, still.correlation) == (1.0, None)
    assert correlation(np.arange(5.0), -np.arange(5.0)) == pytest.approx(-1.0)
