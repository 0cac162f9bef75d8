"""The one place where the service touches cameras, pipeline, gate and beam line: it puts engines together."""

import itertools
import queue
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

from engine.calibration import Calibration
from engine.capture.oni_file import OniFileSource
from engine.capture.openni import OpenNiSource, list_devices, registered_calibration, runtime_available
from engine.capture.returning import ReturningSource
from engine.capture.source import DepthSource
from engine.clock import Clock, MonotonicClock
from engine.commands import Command
from engine.errors import CommandRefusedError, InvalidValueError, RuntimeMissingError, SourceLostError
from engine.frames import ColorImage
from engine.likeness import Likeness
from engine.limits import GateLimits
from engine.live import FrameRecord, GateTransition, LiveView, LoopStatus
from engine.loop import EngineLoop
from engine.model import MotionModel
from engine.notices import LearningNotice
from engine.permits import HoldReason
from engine.pipeline import Pipeline, PipelineSettings
from engine.replaying.witnessed_trainer import WitnessedTrainer
from engine.training import BackgroundTrainer
from engine.witness import WitnessedClock
from service import schemas
from service.beam_lines import make_beam_line
from service.played_beam import check_source
from service.ports import RunningEngine, SessionPlan
from service.session_regions import measuring_with
from service.session_tape import SessionTape
from service.settings import Settings
from service.site_limits import check_window, gate_limits
from service.uncalibrated import check_still_allowed

STOP_TIMEOUT_S = 3.0
RUNTIME_HINT = "the OpenNI2 runtime is missing: apt-get install libopenni2-0"


class EngineAdapter:
    """Makes engines from the site's settings; ``measuring`` is how their pipelines measure and learn."""

    def __init__(self, settings: Settings, *, measuring: PipelineSettings | None = None) -> None:
        self._settings = settings
        learned = PipelineSettings(training=settings.training, likeness=settings.likeness)
        self._measuring = learned if measuring is None else measuring
        self._clock: Clock = MonotonicClock()
        # Asking a camera about itself and starting a session on it do not mix: the runtime would share the device.
        self._camera_lock = threading.Lock()
        self._newest: Callable[[], RunningEngine | None] = lambda: None

    @property
    def is_simulated_beam(self) -> bool:
        """Whether any line is a simulation."""
        return self._settings.is_simulated_beam

    @property
    def trouble(self) -> str | None:
        """Nothing beforehand: an engine of this process is made when it is asked for."""
        return None

    def close(self) -> None:
        """Keep nothing that would have to be closed."""

    def open(self, plan: SessionPlan) -> "LoopEngine":
        """Start an engine on a session, disarmed; raise a TidegateError when source or window cannot be used.

        The site's rules are asked once more: a session may have been written down under others.
        """
        check_source(plan.source, self._settings)
        check_window(plan.window, self._settings)
        check_still_allowed(plan.calibration, self._settings)
        limits = gate_limits(
            plan.window,
            self._settings,
            plan.regions,
            is_calibrated=not plan.calibration.is_device_registration,
        )
        measuring = measuring_with(self._measuring, plan.regions, plan.window)
        tape = SessionTape(plan, self._settings)
        pipeline = Pipeline(
            plan.calibration,
            measuring,
            WitnessedClock(self._clock, tape.taping),
            WitnessedTrainer(BackgroundTrainer(), tape.taping),
        )
        if plan.model is not None:
            pipeline.resume(plan.model)
        with self._camera_lock:
            engine = self._begun(plan, pipeline, tape, limits, measuring)
            self._newest = weakref.ref(engine)
        return engine

    def _begun(
        self, plan: SessionPlan, pipeline: Pipeline, tape: SessionTape, limits: GateLimits, measuring: PipelineSettings
    ) -> "LoopEngine":
        loop = EngineLoop(
            source=self._source(plan),
            pipeline=pipeline,
            beam=make_beam_line(self._settings, self._clock),
            limits=limits,
            clock=self._clock,
            witness=tape.taping,
            journal=plan.journal,
        )
        tape.start(limits, measuring)
        loop.start()
        return LoopEngine(loop, pipeline, tape)

    def registered_calibration(self, uri: str | None) -> Calibration:
        """Return the nominal calibration of a camera that registers depth to colour itself; refuse any other."""
        with self._camera_lock:
            newest = self._newest()
            if newest is not None and not newest.status.is_over:
                msg = "a session runs: its camera is not asked about itself"
                raise CommandRefusedError(msg)
            return _registered(uri)

    def devices(self) -> schemas.DeviceList:
        """List the cameras that could be used."""
        if not runtime_available():
            return schemas.DeviceList(is_runtime_available=False, detail=RUNTIME_HINT, items=[])
        items = [schemas.Device(uri=device.uri, name=f"{device.vendor} {device.name}") for device in list_devices()]
        detail = "" if items else "the OpenNI2 runtime sees no camera"
        return schemas.DeviceList(is_runtime_available=True, detail=detail, items=items)

    def _source(self, plan: SessionPlan) -> DepthSource:
        if isinstance(plan.source, schemas.DeviceSource):
            return self._returning_camera(plan.source.uri, plan.calibration)
        assert plan.recording is not None, "a recording was resolved when the session started"
        return self._player(plan.recording, plan.source.player)

    def _returning_camera(self, uri: str | None, calibration: Calibration) -> DepthSource:
        """Return the camera; when it was away it has another address, so each that is there is looked at in turn."""
        first = iter((self._camera(uri, calibration),))
        turns = itertools.count()
        return ReturningSource(
            lambda: next(first, None) or self._camera(_listed_in_turn(next(turns)), calibration),
            self._clock,
            needs_serial=not calibration.is_device_registration,
        )

    def _camera(self, uri: str | None, calibration: Calibration) -> OpenNiSource:
        is_registered = calibration.is_device_registration
        if is_registered and _registered(uri).sha256 != calibration.sha256:
            msg = "the camera is not the one whose registration this session was created for"
            raise SourceLostError(msg)
        return OpenNiSource(_listed(uri), clock=self._clock, use_device_registration=is_registered)

    def _player(self, path: Path, player: str) -> DepthSource:
        if player == "reader" or (player == "auto" and not runtime_available()):
            return OniFileSource(path, clock=self._clock, is_paced=True)
        if not runtime_available():
            raise RuntimeMissingError(RUNTIME_HINT)
        return OpenNiSource(path, clock=self._clock)


def _registered(uri: str | None) -> Calibration:
    calibration = registered_calibration(_listed(uri))
    if calibration is None:
        bound = "given: this camera does not register depth to colour itself"
        raise InvalidValueError("calibration_id", "missing", bound)
    return calibration


def _listed(uri: str | None) -> str:
    # Only what the runtime lists: it would open a file just as well, and files have to lie in the allowed folders.
    found = [device.uri for device in list_devices()]
    if not found or (uri is not None and uri not in found):
        msg = "the OpenNI2 runtime sees no such camera"
        raise SourceLostError(msg)
    return uri or found[0]


def _listed_in_turn(turn: int) -> str:
    found = [device.uri for device in list_devices()]
    if not found:
        msg = "the OpenNI2 runtime sees no camera"
        raise SourceLostError(msg)
    return found[turn % len(found)]


class LoopEngine:
    """An engine loop with the pipeline it owns, as `RunningEngine`."""

    def __init__(self, loop: EngineLoop, pipeline: Pipeline, tape: SessionTape) -> None:
        self._loop = loop
        self._pipeline = pipeline
        self._tape = tape
        self._is_hung = False

    @property
    def samples(self) -> queue.Queue[FrameRecord]:
        """One record a frame."""
        return self._loop.samples

    @property
    def transitions(self) -> queue.Queue[GateTransition]:
        """Every change of the gate."""
        return self._loop.transitions

    @property
    def notices(self) -> queue.Queue[LearningNotice]:
        """What the learning of models has to tell."""
        return self._loop.notices

    @property
    def latest(self) -> LiveView | None:
        """The newest of everything."""
        return self._loop.latest

    @property
    def has_reference(self) -> bool:
        """Whether motion has a zero; a read of plain values, so safe beside the engine thread."""
        return self._pipeline.has_reference

    @property
    def likeness(self) -> Likeness | None:
        """How far the patient is from the stored model; a read of one reference."""
        return self._pipeline.likeness

    @property
    def model(self) -> MotionModel | None:
        """The model in use; a read of one reference, so safe beside the engine thread."""
        return self._pipeline.model

    @property
    def status(self) -> LoopStatus:
        """Where the engine's life stands; one that hung when told to stop has failed."""
        return LoopStatus.FAILED if self._is_hung else self._loop.status

    @property
    def error(self) -> str | None:
        """Why it failed."""
        return "the engine did not stop when told to; the beam is held" if self._is_hung else self._loop.error

    def picture(self) -> tuple[int, ColorImage] | None:
        """Return the newest frame's index and colour picture."""
        view = self._loop.latest
        return None if view is None else (view.record.measurement.frame_index, view.color)

    def submit(
        self, command: Command, *, answer: Future[None] | None = None, submitted_ns: int | None = None
    ) -> Future[None]:
        """Ask; what another process has asked for comes with its answer and its time."""
        return self._loop.submit(command, answer=answer, submitted_ns=submitted_ns)

    def on_turn(self, tell: Callable[[], None]) -> None:
        """Have somebody told, in the engine's thread, that there is news."""
        self._loop.on_turn = tell

    def note_service(self, alive_ns: int) -> None:
        """Hear that the process which asks was alive then; from the first time on its silence is a fault."""
        self._loop.note_service(alive_ns)

    def hold_line(self, reason: HoldReason) -> None:
        """Hold the line now, without waiting for a decision."""
        self._loop.hold_line(reason)

    def note_presence(self, operator: str) -> None:
        """Hear that a person's page is still looked at."""
        self._loop.note_presence(operator)

    def report_fault(self, reason: HoldReason, detail: str) -> None:
        """Hold the beam because something around the engine failed."""
        self._loop.report_fault(reason, detail)

    def stop(self) -> None:
        """Hold the beam, then end."""
        self._is_hung = not self._loop.stop(STOP_TIMEOUT_S)
        if self._is_hung:
            self._tape.taping.tear("the engine hung")

    def evidence(self) -> dict[str, object]:
        """Return what the audit keeps of the session's tape."""
        return self._tape.finish()
