"""A flat plate tells a unit's scale and offset; what is no flat plate, or at no such distance, is refused."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from engine.calibration.camera_calibration import Disparity
from engine.calibration.procedures.depth_scale import check_distances, corrected, disparity_of, fit_depth_scale
from engine.calibration.procedures.flat_plate import PlateReading, find_plate_steps, read_plate
from engine.capture.oni.writer import OniWriter
from engine.core.errors import CalibrationError, RecordingError
from lab.phantom.rig import STEPS_A_MM
from tests.support.calibration.camera_pair import CAMERAS
from tests.support.calibration.plate_recordings import TRUE, plate_depth, record_plate

pytestmark = pytest.mark.slow


def reading_of(distance_mm):
    """What the plate's reading must be."""
    return (distance_mm - TRUE.offset_mm) / TRUE.scale


class Plates(NamedTuple):
    distances_mm: list
    readings: list
    steps: object


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("plates")


@pytest.fixture(scope="module")
def plates(folder):
    """Three plates, tilted a little each way."""
    places = ((650.0, 2.0), (850.0, 0.0), (1100.0, 4.0))
    paths = [
        record_plate(folder / f"{distance:.0f}.oni", plate_depth(distance, tilt_deg=tilt), seed=int(distance))
        for distance, tilt in places
    ]
    steps = find_plate_steps(paths)
    return Plates(
        [distance for distance, _ in places], [read_plate(path, CAMERAS, steps=steps) for path in paths], steps
    )


def test_a_plate_is_read_where_it_is_however_it_is_tilted(plates):
    for distance, reading in zip(plates.distances_mm, plates.readings, strict=True):
        assert reading.reading_mm == pytest.approx(reading_of(distance), abs=0.2)
    assert [reading.tilt_deg for reading in plates.readings] == pytest.approx([2.0, 0.0, 4.0], abs=0.15)


def test_noise_is_that_of_the_sensor_and_a_warm_one_does_not_drift(plates):
    for reading in plates.readings:
        assert (reading.frames, reading.seconds) == (60, pytest.approx(59 * 0.0334))
        assert 0.3 < reading.noise_mm < 2.5
        assert abs(reading.drift_mm) < 0.15
        assert reading.flatness_mm < 0.6


def test_three_plates_give_the_units_scale_and_offset(plates):
    scale = fit_depth_scale(plates.readings, plates.distances_mm)
    assert scale.has_scale
    assert scale.correction.scale == pytest.approx(TRUE.scale, abs=0.0005)
    depth_mm = scale.correction.scale * reading_of(850.0) + scale.correction.offset_mm
    assert depth_mm == pytest.approx(850.0, abs=0.2)
    assert scale.rms_mm < 0.2
    # Three distances measured to 1 mm each: near their middle, about 1 / sqrt(3).
    assert scale.error_mm == pytest.approx(0.58, abs=0.05)
    made = corrected(CAMERAS, scale, None)
    assert made.depth_correction == scale.correction
    assert made.disparity is None


def test_without_the_sensors_steps_a_reading_is_off_by_its_rounding(plates, folder):
    """The plate that faces the camera shows only a few steps, each cut off to whole millimetres in its own way."""
    raw = read_plate(folder / "850.oni", CAMERAS)
    assert -1.0 < raw.reading_mm - reading_of(850.0) < -0.1
    assert raw.noise_mm == pytest.approx(plates.readings[1].noise_mm, rel=0.3)
    exact, rounded = (fit_depth_scale([raw], [850.0], is_rounding_undone=is_undone) for is_undone in (True, False))
    assert rounded.error_mm == pytest.approx(np.hypot(exact.error_mm, 0.29), abs=0.01)


def test_one_distance_gives_the_offset_alone_and_states_it(plates):
    reading = plates.readings[1]
    scale = fit_depth_scale([reading, reading], [850.0, 850.5])
    assert not scale.has_scale
    assert scale.correction.scale == 1.0
    assert scale.correction.offset_mm == pytest.approx(850.25 - reading.reading_mm, abs=1e-3)
    assert scale.report()["at_mm"] == 850.25


def test_the_sensors_steps_are_found_in_what_the_plates_show(plates):
    disparity = disparity_of(CAMERAS, plates.steps)
    assert disparity.baseline_mm == 75.0
    assert CAMERAS.depth.fx * 75.0 / disparity.step_px == pytest.approx(STEPS_A_MM, rel=1e-3)


def test_steps_that_are_not_certain_are_not_written(plates):
    assert disparity_of(CAMERAS, None) is None
    assert disparity_of(CAMERAS, replace(plates.steps, agreement=0.97)) is None
    scale = fit_depth_scale(plates.readings, plates.distances_mm)
    before = replace(CAMERAS, disparity=Disparity(baseline_mm=75.0, step_px=0.125))
    assert corrected(before, scale, None).disparity == before.disparity


def test_a_camera_that_warms_up_is_seen_to_drift(folder):
    """0.12 % at first, of which exp(-1) is left after 700 s."""
    path = record_plate(folder / "warm.oni", plate_depth(850.0), frames=90, start_s=0.0, end_s=700.0)
    reading = read_plate(path, CAMERAS)
    assert reading.drift_mm == pytest.approx(-0.0012 * (1.0 - np.exp(-1.0)) * 840.0, abs=0.2)


REFUSED = [
    ({"tilt_deg": 14.0}, "tilted by 1[34]"),
    ({"bulge_mm": 12.0}, "off a plane|lies on a plane"),
    ({"fills": 0.3}, "lies on a plane|has readings"),
]


@pytest.mark.parametrize(("shape", "word"), REFUSED, ids=str)
def test_what_is_no_flat_plate_before_the_camera_is_refused(folder, shape, word):
    path = record_plate(folder / "bad.oni", plate_depth(850.0, **shape), frames=32)
    with pytest.raises(CalibrationError, match=word) as refusal:
        read_plate(path, CAMERAS)
    assert refusal.value.field == "bad.oni"


def test_a_plate_full_of_holes_is_refused(folder):
    path = record_plate(folder / "holes.oni", plate_depth(850.0), frames=32, holes=0.7)
    with pytest.raises(CalibrationError, match="has readings"):
        read_plate(path, CAMERAS)


def test_a_short_recording_and_one_of_another_size_are_refused(folder):
    short = record_plate(folder / "short.oni", plate_depth(850.0), frames=12)
    with pytest.raises(CalibrationError, match="12 frames"):
        read_plate(short, CAMERAS)
    with pytest.raises(CalibrationError, match="part"):
        read_plate(short, CAMERAS, part=0.1)
    (folder / "cut.oni").write_bytes(short.read_bytes()[:-50_000])
    with pytest.raises(RecordingError):
        read_plate(folder / "cut.oni", CAMERAS)


def made_reading(reading_mm, name="a.oni"):
    return PlateReading(
        name=name,
        frames=60,
        seconds=2.0,
        reading_mm=reading_mm,
        tilt_deg=0.0,
        flatness_mm=0.1,
        noise_mm=0.9,
        drift_mm=0.0,
    )


def test_a_distance_that_is_wrong_is_named():
    distances = [600.0, 800.0, 1000.0, 1200.0]
    readings = [made_reading(distance, f"{distance:.0f}.oni") for distance in distances]
    with pytest.raises(CalibrationError) as refusal:
        fit_depth_scale(readings, [600.0, 800.0, 1030.0, 1200.0])
    assert refusal.value.field == "distance-mm"
    assert "1000.oni" in refusal.value.value


def test_the_residuals_themselves_report_when_distances_were_measured_worse_than_stated():
    readings = [made_reading(value) for value in (600.0, 801.0, 1002.0, 1199.0)]
    scale = fit_depth_scale(readings, [602.0, 798.0, 1004.0, 1198.0], distance_error_mm=0.1)
    assert scale.error_mm > 0.5


@pytest.mark.parametrize(
    ("distances", "count"),
    [([850.0], 2), ([], 1), ([300.0], 1), ([float("nan")], 1), ([850.0, 900.0], 2), ([850.0, 2001.0], 2)],
    ids=str,
)
def test_distances_that_cannot_be_are_refused(distances, count):
    with pytest.raises(CalibrationError) as refusal:
        check_distances(distances, count)
    assert refusal.value.field == "distance-mm"


def test_a_correction_that_cannot_be_true_is_refused():
    scale = fit_depth_scale([made_reading(600.0), made_reading(1000.0)], [600.0, 1600.0])
    assert scale.correction.scale == pytest.approx(2.5)
    with pytest.raises(CalibrationError) as refusal:
        corrected(CAMERAS, scale, None)
    assert refusal.value.field == "depth_correction.scale"


def test_pixels_that_hardly_ever_read_are_no_part_of_the_plate(folder):
    """Four in ten read in every fourth frame only, on the plate each time."""
    depth = np.full((480, 640), 850, np.uint16)
    flickers = np.random.default_rng(3).random(depth.shape) < 0.4
    with OniWriter(folder / "flicker.oni", color_size=None, depth_codec="NONE") as writer:
        for frame in range(32):
            writer.write_depth(frame * 33_400, np.where(flickers & (frame % 4 > 0), 0, depth).astype(np.uint16))
    with pytest.raises(CalibrationError, match="60 % of it"):
        read_plate(folder / "flicker.oni", CAMERAS)
