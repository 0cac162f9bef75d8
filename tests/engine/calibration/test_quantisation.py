"""Whole millimetres become the depths that the sensor's steps stand for, and nothing else is touched."""

import numpy as np
import pytest

from engine.calibration.camera_calibration import DepthCorrection
from engine.calibration.quantisation import MAX_CORRECTION_MM, count_readings, depth_table_mm, find_steps
from engine.motion.tracking.region_tracker import COUNTED_FRAMES, DepthTable

STEP_PER_MM = 2.92e-6
Y, X = np.mgrid[0:480, 0:640]
RELIEF_MM = 700.0 + 250.0 * np.hypot((X - 320) / 320.0, (Y - 240) / 240.0) ** 2


def read(depth_mm, *, cuts_off, phase, step_per_mm=STEP_PER_MM):
    """What a sensor of this step writes for true depths, and the depths its steps stand for."""
    number = np.rint(1.0 / depth_mm / step_per_mm - phase)
    stands_for = 1.0 / ((number + phase) * step_per_mm)
    return (np.floor(stands_for) if cuts_off else np.rint(stands_for)).astype(np.uint16), stands_for


def picture(seed, **sensor):
    noise = np.random.default_rng(seed).normal(0.0, 0.9, RELIEF_MM.shape)
    return read(RELIEF_MM + noise, **sensor)


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.77])
@pytest.mark.parametrize("cuts_off", [True, False], ids=["cuts off", "rounds"])
@pytest.mark.parametrize("step_per_mm", [2.5e-6, 2.92e-6, 3.6e-6])
def test_readings_become_the_depths_their_steps_stand_for(phase, cuts_off, step_per_mm):
    sensor = {"phase": phase, "cuts_off": cuts_off, "step_per_mm": step_per_mm}
    steps = find_steps(sum(count_readings(picture(seed, **sensor)[0]) for seed in range(4)))
    assert steps is not None
    assert steps.step_per_mm == pytest.approx(step_per_mm, rel=2e-3)
    reading, stands_for = picture(9, **sensor)
    error = depth_table_mm(steps)[reading] - stands_for
    # Half a millimetre for all of them alike cannot be determined and does not matter to motion.
    assert np.abs(error - np.median(error)).max() < 0.25
    assert abs(np.median(error)) < 0.6
    raw = reading - stands_for
    assert np.abs(raw - np.median(raw)).max() > 0.4


def test_steps_narrower_than_a_millimetre_where_it_is_near_do_not_blur_those_farther_away():
    """A stereo camera of 50 mm and 1/32 px: every millimetre occurs up to 0.78 m, every third at 1.4 m."""
    step_per_mm = 1.0 / (383.0 * 50.0 * 32.0)
    room_mm = 480.0 + 920.0 * (Y * 640 + X) / (480.0 * 640.0)
    found = []
    for seed in range(4):
        noise = np.random.default_rng(seed).normal(0.0, 2.0, room_mm.shape)
        reading, _ = read(room_mm + noise, cuts_off=False, phase=0.3, step_per_mm=step_per_mm)
        found.append(find_steps(count_readings(reading)))
    on_chest = slice(780, 900)
    tables = [depth_table_mm(steps)[on_chest] for steps in found]
    assert all(steps.step_per_mm == pytest.approx(step_per_mm, rel=2e-3) for steps in found)
    assert max(float(np.sqrt(np.mean((one - tables[0]) ** 2))) for one in tables) < 0.2


def test_a_camera_that_knows_every_millimetre_is_left_alone():
    depth = np.rint(RELIEF_MM).astype(np.uint16)
    assert find_steps(count_readings(depth)) is None


def test_depths_that_follow_no_rule_are_left_alone():
    rng = np.random.default_rng(3)
    levels = np.sort(rng.choice(np.arange(500, 1300), 200, replace=False))
    occurrences = np.zeros(65536, dtype=np.int64)
    occurrences[levels] = 10
    assert find_steps(occurrences) is None


def test_too_few_depths_say_nothing():
    occurrences = np.zeros(65536, dtype=np.int64)
    occurrences[[800, 802, 804, 806]] = 1000
    assert find_steps(occurrences) is None


def test_no_reading_is_moved_by_more_than_a_millimetre_and_none_outside_of_the_room():
    steps = find_steps(sum(count_readings(picture(seed, cuts_off=True, phase=0.4)[0]) for seed in range(4)))
    table = depth_table_mm(steps)
    assert np.isnan(table[0])
    moved = table[1:] - np.arange(1, 65536)
    assert np.abs(moved).max() <= MAX_CORRECTION_MM
    assert np.all(moved[1500:] == 0.0)
    assert np.all(moved[:440] == 0.0)


def test_the_table_settles_once_and_carries_the_units_correction():
    table = DepthTable(DepthCorrection(scale=1.02, offset_mm=-3.0))
    assert table.table_mm[900] == pytest.approx(1.02 * 900 - 3.0)
    for seed in range(COUNTED_FRAMES):
        assert not table.is_settled
        table.count(picture(seed, cuts_off=True, phase=0.4)[0])
    assert table.is_settled
    assert np.isnan(table.table_mm[0])
    reading, stands_for = picture(50, cuts_off=True, phase=0.4)
    assert np.abs(table.table_mm[reading] - (1.02 * stands_for - 3.0)).max() < 0.2
