"""Camera QA on a flat plate: distance, angles, noise, missing pixels, flatness, drift and warm-up."""

import itertools
from collections.abc import Callable, Iterator

import numpy as np

from engine.calibration.camera_calibration import DepthCorrection
from engine.calibration.procedures.flat_plate import PlateReading, read_plate_frames
from engine.calibration.quantisation import DEPTH_VALUES, DepthSteps, count_readings, find_steps
from engine.core.errors import TidegateError
from engine.core.frames import DepthImage, RgbdFrame
from engine.qa.inputs import SECONDS_BOUNDS, PlateInput
from engine.qa.playing import frames_of, opened
from engine.qa.results import QaCurve, QaFigure, QaNeed, QaSeries
from engine.qa.unmeasured import not_measured

STEP_FRAMES = 12
LAST_S = 30.0
MIN_TRACK_SECONDS = 10
MIN_SECONDS, SLACK_S = SECONDS_BOUNDS[0], 0.2
"""Shortest recording that is judged [s]; the slack allows for lost frames at the end of a ten-second recording."""

NO_CORRECTION = DepthCorrection(scale=1.0, offset_mm=0.0)


def measure_plate(plate: PlateInput, on_frame: Callable[[int], None]) -> tuple[list[QaFigure], list[QaSeries]]:
    """Measure the plate's figures and its distance over time; if it cannot be read, every plate check fails."""
    try:
        with opened(plate.source):
            frames = frames_of(plate.source, plate.seconds)
            first = list(itertools.islice(frames, STEP_FRAMES))
            reading = read_plate_frames(
                "plate",
                _depths(itertools.chain(first, frames)),
                plate.calibration,
                steps=_steps(first),
                part=plate.part,
                on_progress=on_frame,
            )
    except TidegateError as error:
        return not_measured(QaNeed.PLATE, str(error)), []
    if reading.seconds < MIN_SECONDS - SLACK_S:
        why = f"plate: is {reading.seconds:.1f} s: must be at least {MIN_SECONDS:g} s"
        return not_measured(QaNeed.PLATE, why), []
    return _figures(reading, plate.calibration.depth_correction or NO_CORRECTION), [_track(reading)]


def _steps(frames: list[RgbdFrame]) -> DepthSteps | None:
    """Find the sensor's depth steps as a session does, from all pixels of the first frames."""
    counts = np.zeros(DEPTH_VALUES, np.int64)
    for frame in frames:
        counts += count_readings(frame.depth_mm)
    return find_steps(counts)


def _depths(frames: Iterator[RgbdFrame]) -> Iterator[tuple[DepthImage, int]]:
    return ((frame.depth_mm, frame.timestamp_us) for frame in frames)


def _figures(reading: PlateReading, correction: DepthCorrection) -> list[QaFigure]:
    seen = f"{reading.frames} frames, {reading.seconds:.0f} s"
    corrected_mm = correction.scale * reading.reading_mm + correction.offset_mm
    return [
        QaFigure(code="camera_distance_mm", value=corrected_mm, detail=seen),
        QaFigure(code="camera_tilt_x_deg", value=reading.tilt_x_deg),
        QaFigure(code="camera_tilt_y_deg", value=reading.tilt_y_deg),
        QaFigure(code="plate_noise_mm", value=reading.noise_mm),
        QaFigure(code="plate_missing_percent", value=100.0 * reading.missing_share),
        QaFigure(code="plate_drift_mm", value=reading.drift_mm, detail=seen),
        QaFigure(code="plate_flatness_mm", value=reading.flatness_mm),
        _warm_up(reading),
    ]


def _warm_up(reading: PlateReading) -> QaFigure:
    """Slope of the distance over the last 30 s [mm/min], with its standard error."""
    code = "warm_up_drift_mm_per_min"
    at_s, distance_mm = np.array(reading.track).reshape(-1, 2).T
    is_last = at_s >= (at_s[-1] if len(at_s) else 0.0) - LAST_S
    if is_last.sum() < MIN_TRACK_SECONDS:
        return QaFigure(code=code, value=None, detail=f"the recording is shorter than {MIN_TRACK_SECONDS} s")
    (slope, _), covariance = np.polyfit(at_s[is_last], distance_mm[is_last], 1, cov=True)
    total_mm = distance_mm[-5:].mean() - distance_mm[:5].mean()
    return QaFigure(
        code=code,
        value=60.0 * float(slope),
        detail=f"{total_mm:+.2f} mm from the first to the last 5 s",
        uncertainty=60.0 * float(np.sqrt(covariance[0, 0])),
    )


def _track(reading: PlateReading) -> QaSeries:
    at_s = tuple(at for at, _ in reading.track)
    return QaSeries(
        code="plate_distance",
        title="Distance of the plate",
        x_label="time, s",
        y_label="distance as read, mm",
        curves=(QaCurve(name="plate", x=at_s, y=tuple(distance for _, distance in reading.track)),),
    )
