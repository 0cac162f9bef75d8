"""The stage of a QA run that measures the camera's latency, by a light on the beam line's output."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from engine.capture.source import DepthSource, SourceDescription
from engine.core.bounds import check_number
from engine.core.errors import CameraMismatchError, TidegateError
from engine.qa.bounds import not_measured
from engine.qa.latency.captured import CameraLatency, FrameTimes, PictureLog, TimeLog
from engine.qa.latency.light_driver import Light
from engine.qa.latency.light_timing import OUTPUT_BOUNDS_MS, latency_by_light
from engine.qa.playing import frames_of, opened
from engine.qa.results import QaCurve, QaFigure, QaNeed, QaSeries

SECONDS_BOUNDS = (30.0, 120.0)
LEAD_S = 3.0
"""Time of the frames before the light's first and after its last change [s]."""
MOST_POINTS = 1500


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


def measure_latency(given: LightInput, on_frame: Callable[[int], None]) -> tuple[list[QaFigure], list[QaSeries]]:
    """Measure the latency; if that is not possible, every check of the stage fails with the reason."""
    try:
        found, times = _measured(given, on_frame)
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


def _measured(given: LightInput, on_frame: Callable[[int], None]) -> tuple[CameraLatency | str, FrameTimes]:
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
