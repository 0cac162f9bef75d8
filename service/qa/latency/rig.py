"""Build the job that measures a camera's latency: by a light on the beam line's output.

Nothing is opened here but the camera, once, to describe it: the run records which camera and mode it measures.
"""

import threading

from engine.capture import DepthSource, SourceDescription, drivers
from engine.core.clock import NS_PER_S, Clock, MonotonicClock
from engine.qa import Progress, QaBaseline, QaBounds, QaInputs, QaKind, QaReport, run_qa
from engine.qa.latency import LEAD_S, BeamLineLight, LightInput, intervals_ns
from service.core.settings.settings import Settings
from service.engine_host.beam_lines import beam_line_parts, joined, published
from service.qa.guarded_line import GuardedLine
from service.qa.latency.schemas import LatencyRunRequest


class LatencyJob:
    """A run that measures a latency, with its inputs; see `service.qa.jobs.QaJob`."""

    def __init__(self, given: LightInput, line: GuardedLine) -> None:
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
        return drivers.open_camera(drivers.listed_address(uri), clock=self._clock)

    def light_job(self, request: LatencyRunRequest, source: DepthSource, camera: SourceDescription) -> LatencyJob:
        """Build a job with a light on the output of the site's beam line, which it permits."""
        parts = beam_line_parts(self._settings, self._clock)
        line = GuardedLine(published(joined(parts), self._settings, self._clock))
        light = BeamLineLight(line, self._clock, _wait_ns, intervals_ns(request.seed, request.seconds - LEAD_S))
        given = LightInput(
            source=source, camera=camera, light=light, output_ms=request.output_delay_ms, seconds=request.seconds
        )
        return LatencyJob(given, line)


def _wait_ns(span_ns: int) -> None:
    threading.Event().wait(span_ns / NS_PER_S)
