"""The stage of a QA run that measures the camera's latency: by a light, or by a plate with a trace of known times."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np

from engine.capture.source import DepthSource, SourceDescription
from engine.core.bounds import check_number
from engine.core.errors import CameraMismatchError, TidegateError
from engine.verification.qa.latency.captured import FrameTimes, PictureLog, TimeLog, plate_distance_mm
from engine.verification.qa.latency.light_driver import Light
from engine.verification.qa.latency.light_timing import OUTPUT_BOUNDS_MS, latency_by_light
from engine.verification.qa.latency.plate_timing import CLOCK_BOUNDS_MS, latency_by_plate
from engine.verification.qa.latency.results import CameraLatency
from engine.verification.qa.latency.trace_file import TimedTrace
from engine.verification.qa.playing import frames_of, opened
from engine.verification.qa.results import QaCurve, QaFigure, QaNeed, QaSeries
from engine.verification.qa.unmeasured import not_measured

SECONDS_BOUNDS = (30.0, 120.0)
LEAD_S = 3.0
"""Time of the frames before the light's first and after its last change [s]."""
MOST_POINTS = 1500

ReadTrace: TypeAlias = Callable[[], TimedTrace]
"""Returns the plate's trace; called after the last frame."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LightInput:
    """A camera with a light in view.

    Attributes
    ----------
    camera
        The camera that was announced: another one is refused.
    output_ms
        Longest time from the output's read-back to the light [ms].
    seconds
        Time for which frames are read [s of device time].
    """

    source: DepthSource
    camera: SourceDescription
    light: Light
    output_ms: float
    seconds: float

    def __post_init__(self) -> None:
        """Check every number against its bounds; raise InvalidValueError."""
        check_number("output_delay_ms", self.output_ms, *OUTPUT_BOUNDS_MS)
        check_number("seconds", self.seconds, *SECONDS_BOUNDS)


@dataclass(frozen=True, slots=True, kw_only=True)
class MovingPlateInput:
    """A camera with a moving plate in the middle of its view; ``clock_ms`` bounds the error of the trace's times."""

    source: DepthSource
    camera: SourceDescription
    trace: ReadTrace
    clock_ms: float
    seconds: float

    def __post_init__(self) -> None:
        """Check every number against its bounds; raise InvalidValueError."""
        check_number("clock_error_ms", self.clock_ms, *CLOCK_BOUNDS_MS)
        check_number("seconds", self.seconds, *SECONDS_BOUNDS)


LatencyInput: TypeAlias = LightInput | MovingPlateInput


def measure_latency(given: LatencyInput, on_frame: Callable[[int], None]) -> tuple[list[QaFigure], list[QaSeries]]:
    """Measure the latency; if that is not possible, every check of the stage fails with the reason."""
    try:
        found, times = _by_light(given, on_frame) if isinstance(given, LightInput) else _by_plate(given, on_frame)
    except TidegateError as error:
        return not_measured(QaNeed.CAMERA, str(error)), []
    if isinstance(found, str):
        return not_measured(QaNeed.CAMERA, found), []
    return figures_of(found), [_series(found, times)]


def figures_of(found: CameraLatency) -> list[QaFigure]:
    """Return the figures of a latency."""
    half_ms = found.uncertainty_ms
    return [
        QaFigure(code="camera_latency_ms", value=found.median_ms, detail=found.detail, uncertainty=half_ms),
        QaFigure(code="camera_latency_p95_ms", value=found.p95_ms, uncertainty=half_ms),
        QaFigure(code="camera_latency_worst_ms", value=found.worst_ms, uncertainty=half_ms),
        QaFigure(code="camera_latency_uncertainty_ms", value=half_ms),
    ]


def _by_light(given: LightInput, on_frame: Callable[[int], None]) -> tuple[CameraLatency | str, FrameTimes]:
    log, pictures = TimeLog(), PictureLog()
    with _camera(given.source, given.camera), given.light.driving():
        for number, frame in enumerate(frames_of(given.source, given.seconds), start=1):
            log.add(frame)
            pictures.add(frame)
            on_frame(number)
    if given.light.failure:
        return f"the light could not be driven: {given.light.failure}", log.times
    found = latency_by_light(log.times, pictures.pictures, given.light.changes, output_ms=given.output_ms)
    return found, log.times


def _by_plate(given: MovingPlateInput, on_frame: Callable[[int], None]) -> tuple[CameraLatency | str, FrameTimes]:
    log, distance_mm = TimeLog(), []
    with _camera(given.source, given.camera):
        for number, frame in enumerate(frames_of(given.source, given.seconds), start=1):
            log.add(frame)
            distance_mm.append(plate_distance_mm(frame))
            on_frame(number)
    read = given.trace()
    found = latency_by_plate(
        log.times, np.array(distance_mm), read.trace, zero_ns=read.zero_ns, clock_ms=given.clock_ms
    )
    if isinstance(found, CameraLatency) and read.sha256:
        found = replace(found, detail=f"{found.detail}, trace with SHA-256 {read.sha256}")
    return found, log.times


@contextmanager
def _camera(source: DepthSource, announced: SourceDescription) -> Iterator[None]:
    """Open the camera for the block; raise CameraMismatchError if it is not the one that the run was recorded for."""
    with opened(source) as description:
        if description != announced:
            msg = "another camera or another mode was opened than the one that this run was recorded for"
            raise CameraMismatchError(msg)
        yield


def _series(found: CameraLatency, times: FrameTimes) -> QaSeries:
    at_s = (times.device_us - times.device_us[0]) / 1e6
    step = -(-len(at_s) // MOST_POINTS)
    curve = QaCurve(name="frames", x=tuple(at_s[::step].tolist()), y=tuple(found.latencies_ms[::step].tolist()))
    return QaSeries(
        code="camera_latency",
        title="Latency of each frame",
        x_label="time, s",
        y_label="from light to receipt, ms",
        curves=(curve,),
    )
