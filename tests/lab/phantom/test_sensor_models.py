"""The locking sensor against the noise of a real recording, and against the properties of pixel locking."""

import numpy as np
import pytest

from engine.capture.source import SourceDescription
from engine.core.errors import InvalidValueError
from engine.core.frames import RgbdFrame
from engine.qa.device_check import DeviceCheck
from lab.evaluation.sensor_statistics import simulated, statistics_of
from lab.phantom.rig import HEIGHT_PX, STEPS_A_MM, WIDTH_PX
from lab.phantom.sensor import SENSORS, STEPS_A_PX, Holes, Sensor, Unit, depth_table_mm, find_sensor, shift_of

FRAMES = 24
KINECT_MM = (0.93, 0.76, 0.62, 0.48)
"""Of squares of 1, 2, 4 and 8 px between 0.7 and 0.9 m, in a public recording (evaluation.md)."""
NO_HOLES = Holes(
    level=np.full((HEIGHT_PX, WIDTH_PX), -np.inf, dtype=np.float32),
    is_edge=np.zeros((HEIGHT_PX, WIDTH_PX), dtype=np.bool_),
)
# Without the scale error of a warming unit.
TIME_S = 1e5
FAR_SHIFT = float(shift_of(np.array(np.inf)))


def depth_of(reading_mm):
    """Depth of each reading before it was cut to whole millimetres [mm]."""
    table = depth_table_mm()
    exact_mm = STEPS_A_MM / (FAR_SHIFT - np.arange(len(table)))
    return exact_mm[np.searchsorted(table[:1100], reading_mm)]


@pytest.fixture(scope="module")
def sensor():
    return Sensor(Unit(scale=1.0, offset_mm=0.0), 3, "locking")


def test_the_noise_of_square_means_is_that_of_a_recording():
    plane_mm = np.float32(800.0) + np.linspace(-90.0, 90.0, WIDTH_PX, dtype=np.float32) * np.ones((HEIGHT_PX, 1))
    (found,) = statistics_of(
        simulated(np.repeat(plane_mm[None].astype(np.float32), 12, axis=0), find_sensor("locking"))
    )
    assert found.squares_mm[:4] == pytest.approx(KINECT_MM, rel=0.15)


def mean_error(sensor, shift, frames=6):
    """Mean error of some frames of a level plane, over squares of 9 px [shifts]."""
    plane = np.full((HEIGHT_PX, WIDTH_PX), STEPS_A_MM / (FAR_SHIFT - shift), dtype=np.float32)
    read = [sensor.read(plane, NO_HOLES, frame=i, time_s=TIME_S)[6:-6, 5:-5] for i in range(frames)]
    error = np.clip(shift_of(depth_of(np.stack(read))) - shift, -4.0, 4.0).mean(axis=0)
    return error.reshape(52, 9, 70, 9).mean(axis=(1, 3)).ravel()


def test_the_locking_error_has_a_period_of_one_pixel_of_disparity(sensor):
    errors = [mean_error(sensor, 684.0 + steps) for steps in (0, 4, STEPS_A_PX)]
    varying = [error - 0.5 * (errors[0] + errors[1]) for error in errors]  # without the constant part
    assert np.corrcoef(varying[0], varying[2])[0, 1] > 0.6
    assert np.corrcoef(varying[1], varying[2])[0, 1] < -0.6


def test_the_usual_sensor_has_no_error_that_depends_on_the_phase():
    sensor = Sensor(Unit(scale=1.0, offset_mm=0.0), 3)
    first, half = (mean_error(sensor, 684.0 + steps) for steps in (0, 4))
    # What remains is the noise of two means; with locking it is three times as much.
    assert np.std(first - half) < 0.08


def test_an_unknown_sensor_is_refused():
    with pytest.raises(InvalidValueError, match="sensor is 'lidar': must be one of usual, locking, active-stereo"):
        find_sensor("lidar")
    assert find_sensor("drawn-3") == find_sensor("drawn-3") != find_sensor("drawn-4")
    with pytest.raises(InvalidValueError, match="or drawn-N, N below 1000"):
        find_sensor("drawn-1000")
    names = {"usual", "locking", "active-stereo", "active-stereo-rough", "time-of-flight", "structured-light"}
    assert set(SENSORS) == names
    assert find_sensor("structured-light") is find_sensor("usual")


def test_an_error_that_is_left_out_is_gone_and_all_of_them_leave_whole_millimetres():
    plane = np.float32(850.0) + np.linspace(-9.0, 9.0, WIDTH_PX, dtype=np.float32) * np.ones((HEIGHT_PX, 1), np.float32)

    def error_mm(name):
        sensor = Sensor(Unit(scale=1.0, offset_mm=0.0), 3, name)
        return (sensor.read(plane, NO_HOLES, frame=0, time_s=TIME_S) - plane)[32:-32, 64:-64]

    perfect = error_mm("locking without noise, pattern, locking, steps")
    is_jump = np.abs(perfect) > 10.0
    assert is_jump.mean() < 0.01
    assert np.abs(perfect[~is_jump]).max() < 2.0
    assert np.std(perfect[~is_jump]) < 0.45  # of whole millimetres alone 0.29
    all_mm = np.std(error_mm("locking")[~is_jump])
    for error, share in (("noise", 0.8), ("pattern", 0.99), ("locking", 0.99), ("steps", 0.95)):
        assert np.std(error_mm(f"locking without {error}")[~is_jump]) < share * all_mm


@pytest.mark.parametrize("name", ["lidar", "usual without", "usual without dust", "locking without noise and steps"])
def test_an_unknown_sensor_or_error_is_refused(name):
    with pytest.raises(InvalidValueError, match="sensor"):
        find_sensor(name)


# -- sensors of other kinds ------------------------------------------------------------------------------------------


def spread_mm(name, depth_mm, frames=12):
    """Standard deviation over time of a level plane, median over the pixels [mm]."""
    sensor = Sensor(Unit(scale=1.0, offset_mm=0.0), 3, name)
    plane = np.full((HEIGHT_PX, WIDTH_PX), depth_mm, dtype=np.float32)
    read = [sensor.read(plane, NO_HOLES, frame=i, time_s=TIME_S).astype(float) for i in range(frames)]
    return float(np.median(np.std(read, axis=0, ddof=1)))


def test_the_noise_of_stereo_grows_with_the_square_of_the_distance():
    near_mm, far_mm = spread_mm("active-stereo", 700.0), spread_mm("active-stereo", 1400.0)
    # 0.05 px of 383 px x 50 mm, and the rounding to steps and millimetres.
    assert near_mm == pytest.approx(0.05 * 700.0**2 / (383.0 * 50.0), rel=0.2)
    assert far_mm == pytest.approx(0.05 * 1400.0**2 / (383.0 * 50.0), rel=0.2)


def test_stereo_reads_thirty_seconds_of_a_pixel():
    sensor = Sensor(Unit(scale=1.0, offset_mm=0.0), 3, "active-stereo without pattern")
    plane = 1000.0 + np.linspace(-30.0, 30.0, WIDTH_PX, dtype=np.float32) * np.ones((HEIGHT_PX, 1), np.float32)
    levels = np.unique(sensor.read(plane, NO_HOLES, frame=0, time_s=TIME_S))
    steps = 32.0 * 383.0 * 50.0 / levels
    assert np.abs(steps - np.rint(steps)).max() < 0.5 * 32.0 * 383.0 * 50.0 / levels.min() ** 2 + 1e-6
    assert np.median(np.diff(levels)) == pytest.approx(1000.0**2 / (32.0 * 383.0 * 50.0), abs=0.5)


def test_edges_are_fattened_by_stereo_and_mixed_by_time_of_flight():
    scene = np.full((HEIGHT_PX, WIDTH_PX), 1200.0, dtype=np.float32)
    scene[:, 300:] = 800.0
    row = HEIGHT_PX // 2

    def read(name):
        return Sensor(Unit(scale=1.0, offset_mm=0.0), 3, name).read(scene, NO_HOLES, frame=0, time_s=TIME_S)[row]

    assert np.all(np.abs(read("active-stereo")[297:300] - 800.0) < 20.0)
    assert abs(read("active-stereo")[290] - 1200.0) < 40.0
    mixed = read("time-of-flight")[299:301]
    assert np.all((mixed > 850.0) & (mixed < 1150.0))


def test_the_error_of_time_of_flight_swings_with_the_range():
    sensor = Sensor(Unit(scale=1.0, offset_mm=0.0), 3, "time-of-flight without pattern")
    ranges = np.arange(700.0, 1300.0, 25.0)
    errors = [
        float(sensor.read(np.full((HEIGHT_PX, WIDTH_PX), mm, np.float32), NO_HOLES, frame=0, time_s=TIME_S).mean()) - mm
        for mm in ranges
    ]
    wanted = 0.6 * np.sin(2.0 * np.pi * ranges / 300.0)
    assert np.corrcoef(errors, wanted)[0, 1] > 0.98
    assert np.ptp(errors) == pytest.approx(1.2, abs=0.15)


@pytest.mark.parametrize(
    ("name", "verdict"),
    [("usual", "pass"), ("time-of-flight", "pass"), ("active-stereo", "pass"), ("active-stereo-rough", "fail")],
)
def test_the_check_of_a_device_fails_the_noise_with_which_nothing_can_be_gated(name, verdict):
    sensor = Sensor(Unit(scale=1.0, offset_mm=0.0), 5, name)
    size = (WIDTH_PX, HEIGHT_PX)
    described = SourceDescription(kind="x", name=name, depth_size=size, color_size=size, fps=30.0, is_live=True)
    checked = DeviceCheck(described=described)
    color = np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    for i in range(95):
        couch_mm = np.full(color.shape[:2], 850.0, np.float32)
        checked.add(
            RgbdFrame(
                index=i,
                device_index=i,
                timestamp_us=33_333 * i,
                color_timestamp_us=33_333 * i,
                received_ns=33_333_000 * i,
                depth_mm=sensor.read(couch_mm, NO_HOLES, frame=i, time_s=5000.0),
                color=color,
            )
        )
    found = {one.code: one for one in checked.findings()}
    assert found["noise_16"].verdict == verdict, found["noise_16"]
