"""What a flat plate tells of the camera: where it hangs, how quiet it is, and whether it has warmed up."""

import itertools
from collections.abc import Callable, Iterator

import numpy as np

from engine.calibrating.plate import PlateReading, read_plate_frames
from engine.calibration import DepthCorrection
from engine.errors import TidegateError
from engine.frames import DepthImage, RgbdFrame
from engine.qa.inputs import SECONDS_BOUNDS, PlateInput
from engine.qa.playing import frames_of, opened
from engine.qa.results import QaCurve, QaFigure, QaNeed, QaSeries
from engine.qa.unmeasured import not_measured
from engine.stages.quantisation import DEPTH_VALUES, DepthSteps, count_readings, find_steps

LOOKED_AT = 12
LAST_S = 30.0
FEWEST_SECONDS = 10
LEAST_SECONDS, SLACK_S = SECONDS_BOUNDS[0], 0.2
"""A shorter recording is not judged; ten seconds that were asked for end a frame early, or some that were lost."""

NO_CORRECTION = DepthCorrection(scale=1.0, offset_mm=0.0)


def measure_plate(given: PlateInput, on_frame: Callable[[int], None]) -> tuple[list[QaFigure], list[QaSeries]]:
    """Read the plate and say what it tells; what cannot be read fails every check of it."""
    try:
        with opened(given.source):
            frames = frames_of(given.source, given.seconds)
            first = list(itertools.islice(frames, LOOKED_AT))
            reading = read_plate_frames(
                "plate",
                _depths(itertools.chain(first, frames)),
                given.calibration,
                steps=_steps(first),
                part=given.part,
                on_progress=on_frame,
            )
    except TidegateError as error:
        return not_measured(QaNeed.PLATE, str(error)), []
    if reading.seconds < LEAST_SECONDS - SLACK_S:
        why = f"plate: is {reading.seconds:.1f} s: must be at least {LEAST_SECONDS:g} s"
        return not_measured(QaNeed.PLATE, why), []
    return _figures(reading, given.calibration.depth_correction or NO_CORRECTION), [_track(reading)]


def _steps(frames: list[RgbdFrame]) -> DepthSteps | None:
    """Find the sensor's steps as a session does, from the whole of the first pictures."""
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
    """How fast the reading still changes at the end."""
    code = "warm_up_drift_mm_per_min"
    at_s, distance_mm = np.array(reading.track).reshape(-1, 2).T
    is_last = at_s >= (at_s[-1] if len(at_s) else 0.0) - LAST_S
    if is_last.sum() < FEWEST_SECONDS:
        return QaFigure(code=code, value=None, detail=f"the recording is shorter than {FEWEST_SECONDS} s")
    (slope, _), covariance = np.polyfit(at_s[is_last], distance_mm[is_last], 1, cov=True)
    went_mm = distance_mm[-5:].mean() - distance_mm[:5].mean()
    return QaFigure(
        code=code,
        value=60.0 * float(slope),
        detail=f"{went_mm:+.2f} mm from the first to the last 5 s",
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
