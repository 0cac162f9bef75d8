"""A QA run: measure the stages of its kind in order, and judge every figure.

A stage that cannot be measured fails each of its checks with the reason; the next stage still runs. An exception from
the caller's ``on_progress`` cancels the run at once; an open beam line is held first, then closed.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator
from typing import TypeAlias

import numpy as np

from engine.calibration.camera_calibration import DepthCorrection
from engine.calibration.procedures.flat_plate import PlateReading, read_plate_frames
from engine.calibration.quantisation import DEPTH_VALUES, DepthSteps, count_readings, find_steps
from engine.core.errors import TidegateError
from engine.core.frames import DepthImage, RgbdFrame
from engine.qa.bounds import QaBaseline, QaBounds, not_measured
from engine.qa.checks import checks_of, needs_of
from engine.qa.drill import DRILLS, drill_line
from engine.qa.inputs import SECONDS_BOUNDS, PlateInput, QaInputs
from engine.qa.latency.measure import measure_latency
from engine.qa.phantom import measure_phantom
from engine.qa.playing import frames_of, opened
from engine.qa.results import QaCurve, QaFigure, QaKind, QaNeed, QaReport, QaResult, QaSeries, judge

STEP_FRAMES = 12
LAST_S = 30.0
MIN_TRACK_SECONDS = 10
MIN_SECONDS, SLACK_S = SECONDS_BOUNDS[0], 0.2
"""Shortest recording that is judged [s]; the slack allows for lost frames at the end of a ten-second recording."""

NO_CORRECTION = DepthCorrection(scale=1.0, offset_mm=0.0)
Progress: TypeAlias = Callable[[QaNeed, int, int | None], None]
"""Called with (stage, done, total), in frames or pulses; the total is None where it is unknown."""


# Camera QA on a flat plate: distance, angles, noise, missing pixels, flatness, drift and warm-up.
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


def no_progress(_stage: QaNeed, _done: int, _total: int | None) -> None:
    """Ignore the progress."""


def run_qa(
    kind: QaKind,
    inputs: QaInputs,
    *,
    bounds: QaBounds,
    baseline: QaBaseline,
    on_progress: Progress = no_progress,
) -> QaReport:
    """Measure and judge one run.

    Parameters
    ----------
    on_progress
        Called for every frame and after every pulse; an exception from it cancels the run.

    Raises
    ------
    InvalidValueError
        An input that the kind needs is missing; raised before any source or line is opened.
    """
    inputs.check(kind)
    figures: list[QaFigure] = []
    series: list[QaSeries] = []
    for need in needs_of(kind):
        stage_figures, stage_series = _measured(need, inputs, on_progress)
        figures += stage_figures
        series += stage_series
    figures.append(_total(figures))
    return QaReport(kind=kind, results=judge_all(kind, figures, bounds, baseline), series=tuple(series))


def _total(figures: Iterable[QaFigure]) -> QaFigure:
    """Add the gate's delay off and the line's: from the phantom leaving the window to the line read back off [ms]."""
    values = {figure.code: figure.value for figure in figures}
    gate_ms, line_ms = values.get("gate_delay_off_ms"), values.get("beam_readback_off_ms")
    if gate_ms is None or line_ms is None:
        return QaFigure(code="beam_off_total_ms", value=None, detail="the delay of the gate or of the line is unknown")
    detail = f"gate {gate_ms:.0f} ms, line {line_ms:.0f} ms"
    return QaFigure(code="beam_off_total_ms", value=gate_ms + line_ms, detail=detail)


def _measured(need: QaNeed, inputs: QaInputs, on_progress: Progress) -> tuple[list[QaFigure], list[QaSeries]]:
    """Measure one stage; nothing where its input is missing."""
    plate, phantom, beam, camera = inputs.plate, inputs.phantom, inputs.beam, inputs.camera

    def progress(total: int | None) -> Callable[[int], None]:
        return lambda done: on_progress(need, done, total)

    if need is QaNeed.PLATE and plate is not None:
        return measure_plate(plate, progress(None))
    if need is QaNeed.PHANTOM and phantom is not None:
        return measure_phantom(phantom, progress(None))
    if need is QaNeed.BEAM and beam is not None:
        return drill_line(beam, progress(len(DRILLS) * beam.repeats)), []
    if need is QaNeed.CAMERA and camera is not None:
        return measure_latency(camera, progress(None))
    return [], []


def judge_all(
    kind: QaKind, figures: Iterable[QaFigure], bounds: QaBounds, baseline: QaBaseline
) -> tuple[QaResult, ...]:
    """Judge every check of a kind, in the table's order; a check without a figure fails, unless it is optional."""
    measured = {figure.code: figure for figure in figures}
    return tuple(
        judge(
            measured.get(check.code) or QaFigure(code=check.code, value=None),
            check,
            bounds.of(check.code),
            baseline.of(check.code),
        )
        for check in checks_of(kind)
        if check.code in measured or not check.is_optional
    )
