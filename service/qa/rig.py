"""Build QA jobs from recordings or a camera, the calibration and the site's beam line.

Nothing is opened here: the run opens and closes its inputs.
"""

import threading
from pathlib import Path

from engine.calibration import Calibration
from engine.capture import DepthSource, OniFileSource, drivers
from engine.core.clock import NS_PER_S, Clock, MonotonicClock
from engine.gating import GateLimits, amplitude_window
from engine.motion import PipelineSettings
from engine.qa import (
    BeamInput,
    PhantomInput,
    PlateInput,
    Progress,
    QaBaseline,
    QaBounds,
    QaInputs,
    QaKind,
    QaReport,
    read_commanded,
    run_qa,
)
from service.core.errors import BoundError
from service.core.settings.settings import Settings
from service.engine_host.beam_lines import beam_line_parts, drilled_receivers, joined, published, read_beam_on
from service.engine_host.camera_warmth import CameraClaim, ClaimingSource
from service.engine_host.plug_ins import use_plug_ins
from service.engine_host.site_limits.calibrations import checked_camera
from service.qa.guarded_line import GuardedLine
from service.qa.jobs import QaFiles
from service.qa.schemas import QaPhantom, QaPlate, QaRunRequest

DWELL_MS = 100.0
"""The default dwell of a session."""


class EngineJob:
    """A QA run of the engine with its inputs."""

    def __init__(
        self, kind: QaKind, inputs: QaInputs, line: GuardedLine, *, own_baseline: QaBaseline | None = None
    ) -> None:
        self._kind = kind
        self._inputs = inputs
        self.line = line
        self.own_baseline = own_baseline

    def run(self, *, bounds: QaBounds, baseline: QaBaseline, on_progress: Progress) -> QaReport:
        """Measure and judge; see `run_qa`."""
        return run_qa(self._kind, self._inputs, bounds=bounds, baseline=baseline, on_progress=on_progress)


class EngineRig:
    """Builds jobs with a site's settings."""

    def __init__(self, settings: Settings) -> None:
        use_plug_ins(settings)
        self._settings = settings
        self._clock: Clock = MonotonicClock()

    def job(self, request: QaRunRequest, files: QaFiles, calibration: Calibration | None) -> EngineJob:
        """Build the job of a run; raise a TidegateError naming what cannot be used."""
        kind = QaKind(request.kind)
        if request.simulation is not None:
            bound = "omitted: this service has no virtual set-up"
            raise BoundError(f"simulation must be {bound}", field="simulation", value="given", bound=bound)
        parts = beam_line_parts(self._settings, self._clock)
        line = GuardedLine(published(joined(parts), self._settings, self._clock))
        inputs = QaInputs(
            plate=None if request.plate is None else self._plate(request.plate, files, _given(calibration)),
            phantom=None if request.phantom is None else self._phantom(request.phantom, files, _given(calibration)),
            beam=BeamInput(
                line=line,
                clock=self._clock,
                wait_ns=_wait_ns,
                pulse_ms=request.beam.pulse_ms,
                repeats=request.beam.repeats,
                receivers=drilled_receivers(self._settings, self._clock, parts),
                beam_on=read_beam_on(self._settings, self._clock, parts),
            ),
        )
        inputs.check(kind)
        return EngineJob(kind, inputs, line)

    def _plate(self, plate: QaPlate, files: QaFiles, calibration: Calibration) -> PlateInput:
        return PlateInput(
            source=self._source(files.plate, getattr(plate.source, "uri", None), calibration),
            calibration=calibration,
            part=plate.part,
            seconds=plate.seconds,
        )

    def _phantom(self, phantom: QaPhantom, files: QaFiles, calibration: Calibration) -> PhantomInput:
        assert files.trace is not None, "a phantom has a trace"
        lower, upper = phantom.window_lower_mm, phantom.window_upper_mm
        return PhantomInput(
            source=self._source(files.phantom, getattr(phantom.source, "uri", None), calibration),
            calibration=calibration,
            trace=read_commanded(files.trace),
            window_mm=(lower, upper),
            limits=self._limits(lower, upper),
            settings=PipelineSettings(training=self._settings.training, likeness=self._settings.likeness),
            starts_us=phantom.starts_us,
            seconds=phantom.seconds,
        )

    def _limits(self, lower_mm: float, upper_mm: float) -> GateLimits:
        site = self._settings
        return GateLimits(
            window=amplitude_window(lower_mm=lower_mm, upper_mm=upper_mm),
            dwell_ms=max(site.min_dwell_ms, DWELL_MS),
            min_on_ms=site.min_on_ms,
            min_off_ms=site.min_off_ms,
            max_cycles_per_min=site.max_cycles_per_min,
            **site.gate_limits,
        )

    def _source(self, recording: Path | None, uri: str | None, calibration: Calibration) -> DepthSource:
        if recording is not None:
            return OniFileSource(recording, clock=self._clock)
        is_registered = calibration.is_device_registration
        address, options = drivers.listed_address(uri, self._settings.camera_uri), self._settings.camera_options
        source = drivers.open_camera(address, clock=self._clock, use_registration=is_registered, options=options)
        return ClaimingSource(checked_camera(source, calibration, self._settings), CameraClaim(self._settings.data_dir))


def _given(calibration: Calibration | None) -> Calibration:
    assert calibration is not None, "a request with a plate or a phantom has a calibration"
    return calibration


def _wait_ns(span_ns: int) -> None:
    threading.Event().wait(span_ns / NS_PER_S)
