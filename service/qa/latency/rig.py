"""Build the job that measures a camera's latency: by a light on the beam line's output, or by a moving plate.

Nothing is opened here but the camera, once, to describe it: the run records which camera and mode it measures.
"""

import threading
import time
from collections.abc import Callable
from pathlib import Path

from engine.beam.line import BeamLine
from engine.beam.simulated import SimulatedBeamLine
from engine.capture.openni.source import OpenNiSource, list_devices
from engine.capture.source import DepthSource, SourceDescription
from engine.core.clock import NS_PER_S, Clock, MonotonicClock
from engine.core.errors import RecordingError, SourceLostError
from engine.verification.qa.bounds import QaBaseline, QaBounds
from engine.verification.qa.inputs import QaInputs
from engine.verification.qa.latency.light_driver import BeamLineLight
from engine.verification.qa.latency.light_pattern import intervals_ns
from engine.verification.qa.latency.measure import LEAD_S, LatencyInput, LightInput, MovingPlateInput
from engine.verification.qa.latency.trace_file import TimedTrace, read_timed_trace
from engine.verification.qa.latency.virtual import VirtualFaults, virtual_light, virtual_plate
from engine.verification.qa.results import QaKind, QaReport
from engine.verification.qa.run import Progress, run_qa
from service.core.settings.settings import Settings
from service.engine_host.beam_lines import beam_line_parts, joined, published
from service.qa.guarded_line import GuardedLine
from service.qa.latency.schemas import LatencyRunRequest, Method

MAX_CLOCK_STEP_S = 0.001


class LatencyJob:
    """A run that measures a latency, with its inputs; see `service.qa.jobs.QaJob`."""

    def __init__(self, given: LatencyInput, line: GuardedLine) -> None:
        self._inputs = QaInputs(camera=given)
        self.line = line
        self.own_baseline: QaBaseline | None = None

        self.camera = given.camera

    def run(self, *, bounds: QaBounds, baseline: QaBaseline, on_progress: Progress) -> QaReport:
        """Measure and judge; see `run_qa`."""
        return run_qa(QaKind.LATENCY, self._inputs, bounds=bounds, baseline=baseline, on_progress=on_progress)


class LatencyRig:
    """Builds jobs on a site's camera and beam line."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._clock: Clock = MonotonicClock()

    def camera(self, uri: str | None) -> DepthSource:
        """Return a live camera; raise SourceLostError where the runtime does not list it."""
        found = [device.uri for device in list_devices()]
        if not found or (uri is not None and uri not in found):
            msg = "the OpenNI2 runtime sees no such camera"
            raise SourceLostError(msg)
        return OpenNiSource(uri or found[0], clock=self._clock)

    def light_job(self, request: LatencyRunRequest, source: DepthSource, camera: SourceDescription) -> LatencyJob:
        """Build a job with a light on the output of the site's beam line, which it permits."""
        parts = beam_line_parts(self._settings, self._clock)
        line = GuardedLine(published(joined(parts), self._settings, self._clock))
        light = BeamLineLight(line, self._clock, _wait_ns, intervals_ns(request.seed, request.seconds - LEAD_S))
        assert request.output_delay_ms is not None, "a request with a light states it"
        given = LightInput(
            source=source, camera=camera, light=light, output_ms=request.output_delay_ms, seconds=request.seconds
        )
        return LatencyJob(given, line)

    def plate_job(
        self, request: LatencyRunRequest, source: DepthSource, camera: SourceDescription, trace: "PlateTrace"
    ) -> LatencyJob:
        """Build a job with a moving plate; no beam line is opened."""
        assert request.clock_error_ms is not None, "a request with a plate states it"
        given = MovingPlateInput(
            source=source, camera=camera, trace=trace.read, clock_ms=request.clock_error_ms, seconds=request.seconds
        )
        return LatencyJob(given, _no_line(self._clock))


class PlateTrace:
    """Reads the trace of a plate after the last frame.

    Parameters
    ----------
    await_file
        Called before the file is read: it may not exist until the plate's controller has written it.
    """

    def __init__(self, path: Path, await_file: Callable[[Path], None]) -> None:
        self._path, self._await_file = path, await_file
        self._offset_s = _utc_less_monotonic_s()

    def read(self) -> TimedTrace:
        """Return the trace; raise RecordingError if it cannot be used, or the wall clock was set meanwhile."""
        offset_s = _utc_less_monotonic_s()
        if abs(offset_s - self._offset_s) > MAX_CLOCK_STEP_S:
            step_ms = 1000.0 * abs(offset_s - self._offset_s)
            msg = f"this machine's clock was set by {step_ms:.1f} ms during the measurement: measure again"
            raise RecordingError(msg)
        self._await_file(self._path)
        return read_timed_trace(self._path, offset_s)


def virtual_job(method: Method, *, seed: int, seconds: float, delay_ms: float) -> LatencyJob:
    """Build a job on a virtual camera of known latency; the site's camera and beam line are not used."""
    make = virtual_light if method == "light" else virtual_plate
    given = make(VirtualFaults(delay_ms=delay_ms), seed=seed, seconds=seconds)
    return LatencyJob(given, _no_line(MonotonicClock()))


def _no_line(clock: Clock) -> GuardedLine:
    """Return a line in memory for a job that permits none: every job has a line that a cancel can take away."""
    line: BeamLine = SimulatedBeamLine(clock)
    return GuardedLine(line)


def _utc_less_monotonic_s() -> float:
    """Return seconds since 1970 less the monotonic clock's, read twice around."""
    before_ns = time.monotonic_ns()
    utc_ns = time.time_ns()
    after_ns = time.monotonic_ns()
    return (utc_ns - (before_ns + after_ns) / 2) / NS_PER_S


def _wait_ns(span_ns: int) -> None:
    threading.Event().wait(span_ns / NS_PER_S)
