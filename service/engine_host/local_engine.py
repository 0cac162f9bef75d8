"""Assembles an engine from camera, pipeline, gate and beam line; the only module of the service that does."""

import itertools
import queue
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path

from engine.calibration import Calibration, CameraViewMeter, built_in_calibration
from engine.capture import DepthSource, LiveSource, OniFileSource, ReturningSource, drivers
from engine.control import Command, EngineLoop, EngineStatus, FrameRecord, GateTransition, LoopStatus
from engine.core.clock import Clock, MonotonicClock
from engine.core.errors import CommandRefusedError, InvalidValueError, RuntimeMissingError, SourceLostError
from engine.core.frames import ColorImage
from engine.core.gate_state import HoldReason
from engine.core.input_tap import TappedClock
from engine.core.learning_status import LearningEvent
from engine.core.warmth import Warmth
from engine.gating import GateLimits
from engine.motion import BackgroundTrainer, Outcome, Pipeline, PipelineSettings, Trainer
from engine.offline.replay import TappedTrainer
from service.core.schemas import sessions
from service.core.settings.settings import Settings
from service.engine_host.beam_lines import beam_on_state, make_beam_line
from service.engine_host.camera_warmth import CameraKeeper, WarmingSource, WarmthFile, warm_up_s
from service.engine_host.plug_ins import use_plug_ins
from service.engine_host.protocols import RunningEngine, SessionPlan
from service.engine_host.session_tape import SessionTape
from service.engine_host.site_limits.calibrations import check_still_allowed, checked_camera
from service.engine_host.site_limits.recording_folders import check_source
from service.engine_host.site_limits.window_limits import (
    check_head_direction,
    check_window,
    gate_limits,
    measuring_with,
)

STOP_TIMEOUT_S = 3.0
HUNG = "the engine did not stop in time; the beam is held"


class LocalEngine:
    """Builds engines from the site's settings.

    Parameters
    ----------
    measuring
        Replaces the settings of measuring and training.
    trainer
        Makes what runs the training jobs of a session.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        measuring: PipelineSettings | None = None,
        trainer: Callable[[], Trainer[Outcome]] = BackgroundTrainer,
    ) -> None:
        use_plug_ins(settings)
        self._trainer = trainer
        self._settings = settings
        learned = PipelineSettings(
            training=settings.training,
            likeness=settings.likeness,
            marker_placement_mm=settings.marker_placement_mm,
        )
        self._measuring = learned if measuring is None else measuring
        self._clock: Clock = MonotonicClock()
        # Asking a camera about itself and starting a session on it do not mix: the runtime would share the device.
        self._camera_lock = threading.Lock()
        self._newest: Callable[[], RunningEngine | None] = lambda: None
        self._warmth = WarmthFile(settings.data_dir)
        self._keeper = CameraKeeper(settings, self._warmth, self._clock)

    def stand_by(self) -> None:
        """Keep the room's camera running until a session is opened."""
        self._keeper.start()

    @property
    def is_simulated_beam(self) -> bool:
        """Whether any line is a simulation."""
        return self._settings.is_simulated_beam

    @property
    def trouble(self) -> str | None:
        """Always None: an engine in this process is built when its session starts."""
        return None

    def close(self) -> None:
        """Release a camera that is kept running."""
        self._keeper.end()

    def open(self, plan: SessionPlan) -> "LoopEngine":
        """Start an engine on a session, disarmed; raise a TidegateError when source or window cannot be used.

        The site's rules are asked once more: a session may have been written down under others.
        """
        check_source(plan.source, self._settings)
        check_window(plan.window, self._settings)
        check_head_direction(plan.head_direction, self._settings)
        check_still_allowed(plan.calibration, self._settings)
        limits = gate_limits(
            plan.window,
            self._settings,
            plan.regions,
            is_calibrated=not plan.calibration.is_built_in,
            head_direction=plan.head_direction,
            camera_latency_ms=plan.camera_latency_ms,
        )
        self._keeper.end()
        measuring = measuring_with(self._measuring, plan.regions, plan.window, plan.head_direction)
        if isinstance(plan.source, sessions.DeviceSource):
            address = plan.source.uri or self._settings.camera_uri
            if address:  # otherwise its kind is not known before it is open
                measuring = replace(measuring, most_noise_mm=drivers.most_noise_mm(address))
        tape = SessionTape(plan, self._settings)
        pipeline = Pipeline(
            plan.calibration,
            measuring,
            TappedClock(self._clock, tape.tap),
            TappedTrainer(self._trainer(), tape.tap),
            learns_after=True,
        )
        if plan.model is not None:
            pipeline.learner.models.resume(plan.model)
        if plan.first_reference is not None:
            pipeline.learner.history.restore(plan.first_reference)
        if plan.plan_position is not None:
            pipeline.learner.history.restore_plan(plan.plan_position)
        with self._camera_lock:
            engine = self._begun(plan, pipeline, tape, limits, measuring)
            self._newest = weakref.ref(engine)
        return engine

    def _begun(
        self, plan: SessionPlan, pipeline: Pipeline, tape: SessionTape, limits: GateLimits, measuring: PipelineSettings
    ) -> "LoopEngine":
        source, warmth = self._source(plan)
        limits = replace(limits, warm_up_s=warmth.warm_up_s)
        beam = make_beam_line(self._settings, self._clock)
        loop = EngineLoop(
            source=source,
            measurer=pipeline,
            learner=pipeline.learner,
            beam=beam,
            beam_on=lambda: beam_on_state(beam),
            camera_view=CameraViewMeter(plan.calibration.depth, warmth).look,
            fraction_arming=plan.fraction_arming,
            limits=limits,
            clock=self._clock,
            tap=tape.tap,
            journal=plan.journal,
        )
        tape.start(limits, measuring, serial=lambda: loop.status.source.serial if loop.status.source else "")
        loop.start()
        return LoopEngine(loop, tape)

    def built_in_calibration(self, uri: str | None) -> Calibration:
        """Return the calibration that a camera brings itself; refuse one that has none."""
        with self._camera_lock, self._keeper:
            newest = self._newest()
            if newest is not None and not newest.status.is_over:
                msg = "a session is running: its camera cannot be queried"
                raise CommandRefusedError(msg)
            return _built_in(drivers.listed_address(uri, self._settings.camera_uri))

    def note_server_turn(self, turned_ns: int) -> None:
        """Do nothing: an engine in the server's own process has no silence to supervise, as tests run it."""

    def devices(self) -> sessions.DeviceList:
        """List the cameras that could be used."""
        if not drivers.is_any_available():
            return sessions.DeviceList(
                is_runtime_available=False,
                detail=drivers.missing_text(),
                kinds=sessions.device_kinds(drivers.kinds()),
                items=[],
            )
        items = [
            sessions.Device(uri=device.uri, name=f"{device.vendor} {device.name}")
            for device in drivers.list_cameras(self._settings.camera_uri)
        ]
        detail = "" if items else drivers.none_text()
        return sessions.DeviceList(
            is_runtime_available=True, detail=detail, kinds=sessions.device_kinds(drivers.kinds()), items=items
        )

    def _source(self, plan: SessionPlan) -> tuple[DepthSource, Warmth]:
        """Return a session's frames, and how warm its camera is; a recording needs no warming."""
        if not isinstance(plan.source, sessions.DeviceSource):
            assert plan.recording is not None, "a recording was resolved when the session started"
            return self._player(plan.recording, plan.source.player), Warmth(0.0)
        address = drivers.listed_address(plan.source.uri, self._settings.camera_uri)
        warmth = Warmth(warm_up_s(address, self._settings))
        camera = self._returning_camera(address, plan.calibration)
        return WarmingSource(camera, warmth, self._warmth, address), warmth

    def _returning_camera(self, address: str, calibration: Calibration) -> DepthSource:
        """Return a source that reopens the camera; its address may change, so all listed ones are tried in turn."""
        first = iter((self._camera(address, calibration),))
        turns = itertools.count()
        pinned = self._settings.camera_uri
        return ReturningSource(
            lambda: (
                next(first, None) or self._camera(drivers.address_in_turn(next(turns), address, pinned), calibration)
            ),
            self._clock,
            needs_serial=not calibration.is_device_registration,
        )

    def _camera(self, address: str, calibration: Calibration) -> LiveSource:
        """Return the camera of a listed address, not opened."""
        if calibration.is_built_in and _built_in(address).sha256 != calibration.sha256:
            msg = "the camera is not the one whose own calibration this session was created with"
            raise SourceLostError(msg)
        is_registered = calibration.is_device_registration
        options = self._settings.camera_options
        source = drivers.open_camera(address, clock=self._clock, use_registration=is_registered, options=options)
        return checked_camera(source, calibration, self._settings)

    def _player(self, path: Path, player: str) -> DepthSource:
        played = None if player in {"reader", "repeated"} else drivers.real_time_player(path, clock=self._clock)
        if played is None and player == "openni":
            raise RuntimeMissingError(drivers.missing_text())
        return played or OniFileSource(path, clock=self._clock, is_paced=True, is_repeated=player == "repeated")


def _built_in(address: str) -> Calibration:
    calibration = built_in_calibration(address)
    if calibration is None:
        bound = "given: this camera neither registers depth to colour itself nor has a calibration of its maker"
        raise InvalidValueError("calibration_id", "missing", bound)
    return calibration


class LoopEngine:
    """An engine loop in this process, as `RunningEngine`."""

    def __init__(self, loop: EngineLoop, tape: SessionTape) -> None:
        self._loop = loop
        self._tape = tape
        self._is_hung = False

    @property
    def samples(self) -> queue.Queue[FrameRecord]:
        """One record per frame."""
        return self._loop.samples

    @property
    def transitions(self) -> queue.Queue[GateTransition]:
        """Every transition of the gate."""
        return self._loop.transitions

    @property
    def notices(self) -> queue.Queue[LearningEvent]:
        """Events of the training of models."""
        return self._loop.notices

    @property
    def status(self) -> EngineStatus:
        """The engine's status; failed if the engine did not stop in time."""
        status = self._loop.status
        return replace(status, run_state=LoopStatus.FAILED, error=HUNG) if self._is_hung else status

    def picture(self) -> tuple[int, ColorImage] | None:
        """Return the newest frame's index and colour picture."""
        view = self._loop.status.view
        return None if view is None else (view.record.measurement.frame_index, view.color)

    def submit(
        self, command: Command, *, answer: Future[None] | None = None, submitted_ns: int | None = None
    ) -> Future[None]:
        """Submit a command; for one of another process, with its future and its time of arrival [ns]."""
        return self._loop.submit(command, answer=answer, submitted_ns=submitted_ns)

    def on_turn(self, callback: Callable[[], None]) -> None:
        """Set the function that the engine's thread calls after each turn; it must not wait."""
        self._loop.on_turn = callback

    def note_service(self, alive_ns: int) -> None:
        """Note when the service served last [ns]; after the first call its silence is a fault."""
        self._loop.note_service(alive_ns)

    def hold_line(self, reason: HoldReason) -> None:
        """Hold the line now, without waiting for a decision."""
        self._loop.hold_line(reason)

    def note_presence(self, operator: str) -> None:
        """Note that the operator is present at the page."""
        self._loop.note_presence(operator)

    def report_fault(self, reason: HoldReason, detail: str) -> None:
        """Fault the gate, which holds the beam, because something outside of the engine failed."""
        self._loop.report_fault(reason, detail)

    def stop(self) -> None:
        """Hold the beam, then end the engine; note if it hangs."""
        self._is_hung = not self._loop.stop(STOP_TIMEOUT_S)
        if self._is_hung:
            self._tape.tap.tear("the engine hung")

    def evidence(self) -> dict[str, object]:
        """Return what the audit records of the session's tape."""
        return self._tape.finish()
