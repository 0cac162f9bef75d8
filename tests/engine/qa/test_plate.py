"""What a flat plate tells, with faults that are known, from depth pictures with the sensor's own noise."""

from dataclasses import replace

import numpy as np
import pytest

from engine.calibration.camera_calibration import DepthCorrection
from engine.core.errors import FrameTimeoutError, InvalidValueError, RecordingError, SourceLostError
from engine.qa.bounds import QaBounds
from engine.qa.checks import check_of
from engine.qa.inputs import PlateInput
from engine.qa.results import QaKind, QaNeed, QaVerdict
from engine.qa.run import judge_all, measure_plate
from lab.virtual_qa import (
    DISTANCE_MM,
    TILT_X_DEG,
    TILT_Y_DEG,
    VIRTUAL_BASELINE,
    VIRTUAL_CALIBRATION,
    RigFaults,
    virtual_plate,
)
from tests.support.qa.altered_plate import Altered

pytestmark = pytest.mark.slow

SECONDS = 12.0


class Slow:
    """A source whose camera takes so many times as long for each frame."""

    def __init__(self, source, *, times):
        self._source, self._times = source, times
        self.open, self.close = source.open, source.close

    def read(self, timeout_s):
        frame = self._source.read(timeout_s)
        return replace(frame, timestamp_us=self._times * frame.timestamp_us)


def plate(change=lambda depth, _index: depth, *, faults=None, seconds=SECONDS, **fails):
    given = virtual_plate(faults or RigFaults(), seed=3, seconds=seconds)
    return replace(given, source=Altered(given.source, change, **fails))


def results_of(given):
    figures, _ = measure_plate(given, lambda _frames: None)
    results = judge_all(QaKind.ANNUAL, figures, QaBounds(), VIRTUAL_BASELINE)
    return {result.code: result for result in results if check_of(result.code).needs is QaNeed.PLATE}


def not_passed(results):
    return {code for code, result in results.items() if result.verdict is not QaVerdict.PASS}


def test_a_healthy_plate_is_where_it_lies():
    results = results_of(plate())
    assert not_passed(results) == set()
    assert results["camera_distance_mm"].value == pytest.approx(DISTANCE_MM, abs=0.3)
    assert results["camera_tilt_x_deg"].value == pytest.approx(TILT_X_DEG, abs=0.1)
    assert results["camera_tilt_y_deg"].value == pytest.approx(TILT_Y_DEG, abs=0.1)


@pytest.mark.parametrize("offset_mm", [2.0, -2.0])
def test_two_millimetres_fail_the_distance_alone_and_keep_their_sign(offset_mm):
    results = results_of(plate(faults=RigFaults(offset_mm=offset_mm)))
    assert not_passed(results) == {"camera_distance_mm"}
    assert results["camera_distance_mm"].verdict is QaVerdict.FAIL
    # Nearer to the camera is positive motion, and a smaller distance.
    assert results["camera_distance_mm"].deviation == pytest.approx(-offset_mm, abs=0.3)


@pytest.mark.parametrize(("axis", "code"), [(1, "camera_tilt_x_deg"), (0, "camera_tilt_y_deg")])
def test_a_camera_that_was_knocked_fails_the_angle_of_its_axis(axis, code):
    def turn(depth, _index):
        ray = (np.arange(depth.shape[axis]) - depth.shape[axis] / 2.0) / 288.0
        lean = 1.0 - np.tan(np.deg2rad(1.5)) * ray
        return np.rint(depth * (lean[None, :] if axis == 1 else lean[:, None])).astype(np.uint16)

    results = results_of(plate(turn))
    assert code in not_passed(results)
    assert results[code].deviation == pytest.approx(1.5, abs=0.2)


def test_a_camera_that_has_not_warmed_up_fails_and_its_way_is_reported_with_its_sign():
    results = results_of(plate(faults=RigFaults(drift_mm_per_min=-0.4), seconds=30.0))
    assert results["warm_up_drift_mm_per_min"].verdict is QaVerdict.FAIL
    assert results["warm_up_drift_mm_per_min"].value == pytest.approx(0.4, abs=0.06)
    assert results["plate_drift_mm"].value == pytest.approx(0.2, abs=0.03)
    assert 0.0 < results["warm_up_drift_mm_per_min"].uncertainty < 0.05


def test_drift_that_is_over_at_the_end_is_drift_of_the_recording_but_warm_all_the_same():
    def settles(depth, index):
        return np.rint(depth + max(6.0 - index * 0.02, 0.0)).astype(np.uint16)

    results = results_of(plate(settles, seconds=55.0))
    assert results["warm_up_drift_mm_per_min"].verdict is QaVerdict.PASS
    assert results["plate_drift_mm"].value < -1.0


def test_a_camera_that_grew_noisy_fails():
    noise = np.random.default_rng(1)

    def noisy(depth, _index):
        return np.rint(depth + noise.normal(0.0, 4.0, depth.shape)).astype(np.uint16)

    results = results_of(plate(noisy))
    assert results["plate_noise_mm"].verdict is QaVerdict.FAIL
    assert results["plate_noise_mm"].value == pytest.approx(4.1, abs=0.3)


def test_a_bent_plate_fails_its_flatness():
    def bent(depth, _index):
        ray = (np.arange(depth.shape[1]) - depth.shape[1] / 2.0) / 288.0
        return np.rint(depth + 5.0 * np.cos(25.0 * ray)[None, :]).astype(np.uint16)

    assert results_of(plate(bent))["plate_flatness_mm"].verdict is QaVerdict.FAIL


def test_missing_pixels_are_counted_over_all_frames():
    def holes(depth, index):
        depth[:, index % 4 :: 4] = 0
        return depth

    results = results_of(plate(holes))
    # In a quarter of the frames a pixel is a hole; 75 % of readings are too few for a mean, and that is reported too.
    assert results["plate_missing_percent"].verdict is QaVerdict.FAIL

    def some(depth, index):
        if index % 8 == 0:
            depth[:] = 0
        return depth

    assert results_of(plate(some))["plate_missing_percent"].value == pytest.approx(12.5, abs=0.5)


def test_a_second_in_which_nothing_was_seen_is_left_out():
    def covered(depth, index):
        return np.zeros_like(depth) if 100 <= index < 165 else depth

    results = results_of(plate(covered, seconds=15.0))
    assert not_passed(results) == {"plate_missing_percent"}
    assert results["plate_missing_percent"].value == pytest.approx(100.0 * 65 / 449, abs=0.5)


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"change": lambda depth, _index: np.zeros_like(depth)}, "has readings"),
        ({"seconds": 0.5}, "frames"),
        ({"error": SourceLostError("unplugged")}, "unplugged"),
        ({"fails_at": 100, "error": RecordingError("the file is damaged")}, "damaged"),
        ({"fails_at": 5, "error": FrameTimeoutError("no frame")}, "no frame"),
    ],
)
def test_what_cannot_be_read_fails_every_check_of_the_plate_and_states_why(given, says):
    made = plate(**given)
    results = results_of(made)
    assert {result.verdict for result in results.values()} == {QaVerdict.FAIL}
    assert all(says in result.detail for result in results.values())
    assert (made.source.opened, made.source.closed) == (1, 1)


@pytest.mark.parametrize("seconds", [1.5, 3.0, 9.5])
def test_a_recording_of_less_than_10_s_is_not_measured_at_all_however_much_it_was_off(seconds):
    results = results_of(plate(faults=RigFaults(drift_mm_per_min=30.0), seconds=seconds))
    assert {(result.verdict, result.value) for result in results.values()} == {(QaVerdict.FAIL, None)}
    assert all("at least 10 s" in result.detail for result in results.values())


def test_ten_seconds_are_measured_and_all_that_is_asked_of_a_longer_recording():
    assert all(result.value is not None for result in results_of(plate(seconds=10.1)).values())
    asked = replace(plate(seconds=20.0), seconds=10.0)
    assert not_passed(results_of(asked)) == set()


def test_a_drift_for_which_there_are_too_few_seconds_is_not_measured_and_no_drift_of_0():
    given = plate(seconds=1.5)
    results = results_of(replace(given, source=Slow(given.source, times=10)))
    assert results["camera_distance_mm"].value is not None
    assert results["plate_drift_mm"].value is None
    assert results["plate_drift_mm"].verdict is QaVerdict.FAIL


def test_the_distance_is_the_one_a_session_measures_corrected_by_the_calibration():
    made = plate()
    correction = DepthCorrection(scale=1.01, offset_mm=-3.0)
    corrected = replace(made, calibration=replace(VIRTUAL_CALIBRATION, depth_correction=correction))
    plain_mm = results_of(plate())["camera_distance_mm"].value
    assert results_of(corrected)["camera_distance_mm"].value == pytest.approx(1.01 * plain_mm - 3.0, abs=1e-6)


def test_a_camera_of_another_size_is_refused_in_the_result():
    made = plate(lambda depth, _index: np.ascontiguousarray(depth[::2, ::2]))
    assert all("px" in result.detail for result in results_of(made).values())


def test_no_more_is_read_than_was_asked_for():
    made = replace(plate(seconds=20.0), seconds=10.0)
    frames = []
    measure_plate(made, frames.append)
    assert frames[-1] == pytest.approx(300, abs=2)
    assert made.source.closed == 1


def test_cancelling_closes_the_source():
    made = plate()

    def cancel(_frames):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure_plate(made, cancel)
    assert made.source.closed == 1


@pytest.mark.parametrize(
    ("field", "value"), [("part", 0.1), ("part", 1.5), ("seconds", 5.0), ("seconds", float("nan"))]
)
def test_numbers_out_of_their_bounds_are_refused_by_name(field, value):
    with pytest.raises(InvalidValueError) as refusal:
        PlateInput(source=plate().source, calibration=VIRTUAL_CALIBRATION, **{field: value})
    assert refusal.value.field == f"plate.{field}"
