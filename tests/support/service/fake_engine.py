"""An engine that does what a test tells it, behind the same ports as the real one."""

import queue
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from itertools import count

import numpy as np

from engine.beam.beam_on import BeamOnState
from engine.calibration.camera_calibration import Calibration, nominal_calibration
from engine.capture.source import SourceDescription
from engine.control.arming import CountersignatureState
from engine.control.outputs import FrameRecord, GateTransition, LatencySummary, LiveView, LoopStatus
from engine.control.records import EngineStatus
from engine.control.turn_inputs import Command
from engine.core.breath import Breath
from engine.core.commands import Acknowledge, Arm, CorrectBaseline, Disarm, HoldBeam, ReleaseBeam
from engine.core.errors import CommandRefusedError, TidegateError
from engine.core.frames import (
    Lost,
    LostReason,
    Measurement,
    MeasurementState,
    Motion,
    Projection,
    SeenShares,
    TrainingProgress,
)
from engine.core.gate_state import GateState, HoldReason
from engine.core.learning_status import LearningEvent, LearningStatus, PatientMatch
from engine.core.motion_model import MotionModel
from engine.core.signals import Ranges
from engine.gating.active_window import SetWindow
from engine.gating.supervision.checks import CheckState
from engine.gating.windows import ConditionState, GateWindow, amplitude_window
from service.core.schemas import sessions
from service.engine_host.protocols import SessionPlan

FRAME_NS = 33_370_000
SEEN = SeenShares(whole=0.98, thorax=0.97, abdomen=0.99, cells=np.ones((14, 8)))


def make_motion(whole_mm: float = 1.5) -> Motion:
    regions = np.full((14, 8), whole_mm, dtype=np.float32)
    regions[0, 0] = np.nan
    projection = Projection(
        beta=np.zeros(3), coefficients=np.zeros(3), residual_mm=0.7, valid_share=0.98, inlier_share=0.97
    )
    return Motion(
        whole_mm=whole_mm,
        thorax_mm=1.1,
        abdomen_mm=1.9,
        volume_l=0.21,
        regions_mm=regions,
        regions_depth_mm=regions,
        points_mm=np.zeros(0),
        projection=projection,
        seen=SEEN,
        reference_seen=SEEN,
    )


def make_measurement(index: int, *, whole_mm: float | None = 1.5, received_ns: int = 1_000) -> Measurement:
    is_lost = whole_mm is None
    return Measurement(
        frame_index=index,
        timestamp_us=index * 33_370,
        received_ns=received_ns,
        measured_ns=received_ns + 1,
        missed_frames=0,
        state=MeasurementState.LOST if is_lost else MeasurementState.MEASURING,
        motion=None if is_lost else make_motion(whole_mm),
        lost=Lost(reason=LostReason.MARKER_LOST, detail="test") if is_lost else None,
    )


def make_model(seed: int = 1) -> MotionModel:
    random = np.random.default_rng(seed)
    return MotionModel(
        mean_mm=np.full((350, 200), 850.0, dtype=np.float32),
        components=random.standard_normal((3, 350, 200)).astype(np.float32),
        eigenvalues_mm2=np.array([98.0, 1.5, 0.5]),
        known=np.ones((350, 200), dtype=bool),
        training_frames=100,
        cycles=4,
        seconds=16.0,
        calibration_sha256="0" * 64,
    )


class FakeRunning:
    """One life of the fake engine; tests call :meth:`frame`, :meth:`transition` and :meth:`end`."""

    def __init__(self, plan: SessionPlan | None, *, sample_capacity: int = 900) -> None:
        self.plan = plan
        self.samples: queue.Queue[FrameRecord] = queue.Queue(sample_capacity)
        self.transitions: queue.Queue[GateTransition] = queue.Queue(260)
        self.notices: queue.Queue[LearningEvent] = queue.Queue(64)
        self.latest: LiveView | None = None
        self.has_reference = True
        self.likeness: PatientMatch | None = None
        self.model: MotionModel | None = None
        self.run_state = LoopStatus.RUNNING
        self.error: str | None = None
        self.commands: list[Command] = []
        self.asked_ns: list[int | None] = []
        self.faults: list[HoldReason] = []
        self.refuse_with: TidegateError | None = None
        self.is_silent = False
        self.present: list[str] = []
        self.window: GateWindow = amplitude_window(lower_mm=-1.0, upper_mm=3.0, hysteresis_mm=0.2)
        self.conditions: tuple[ConditionState, ...] = ()
        self.breaths: tuple[Breath, ...] = ()
        self.learned_ranges: Ranges = {}
        self.operator_hold: str | None = None
        self.arming_state = "5e" * 16
        self.countersignature = CountersignatureState()
        self.fraction_arming = None if plan is None else plan.fraction_arming
        self.armed_by: str | None = None
        self.beam_on: BeamOnState | None = None
        self.is_reason_needed = False
        self.checks: tuple[CheckState, ...] = ()
        self.camera_ms: float | None = None
        self.gate = GateState.DISARMED
        self.reason = HoldReason.DISARMED
        self._index = count()

    def submit(self, command: Command, *, submitted_ns: int | None = None) -> Future[None]:
        self.commands.append(command)
        self.asked_ns.append(submitted_ns)
        answer: Future[None] = Future()
        if self.is_silent:
            return answer
        if self.refuse_with is not None and not isinstance(command, Disarm):
            answer.set_exception(self.refuse_with)
            return answer
        states = {Arm: GateState.HOLD, Disarm: GateState.DISARMED, Acknowledge: GateState.DISARMED}
        if type(command) in states:
            self.transition(states[type(command)], HoldReason.DISARMED, operator=command.operator)
        self._obey(command)
        answer.set_result(None)
        return answer

    @property
    def operator_holds(self) -> tuple[str, ...]:
        return () if self.operator_hold is None else (self.operator_hold,)

    def _obey(self, command: Command) -> None:
        match command:
            case Arm():
                self.armed_by = command.operator
            case Disarm():
                self.armed_by = None
            case HoldBeam():
                self.operator_hold = command.operator
            case ReleaseBeam():
                self.operator_hold = None
                self.armed_by = command.operator if command.is_person else self.armed_by
            case Acknowledge():
                self.reason = HoldReason.DISARMED
                if self.latest is not None:
                    record = replace(self.latest.record, gate_state=GateState.DISARMED, hold_reason=self.reason)
                    self.latest = replace(self.latest, record=record)
            case CorrectBaseline():
                self.window = self.window.shifted(self.window.choices[0], command.by)
                if self.latest is not None:
                    self.latest = replace(self.latest, window=self.window)
            case SetWindow():
                self.window = command.window
                if self.latest is not None:
                    self.latest = replace(self.latest, window=self.window)
        if self.latest is not None:
            self.latest = replace(self.latest, operator_holds=self.operator_holds, armed_by=self.armed_by)

    @property
    def status(self) -> EngineStatus:
        learning = LearningStatus(model=self.model, has_reference=self.has_reference, patient_match=self.likeness)
        return EngineStatus(
            run_state=self.run_state,
            error=self.error,
            view=self.latest,
            learning=learning,
            learned_ranges=self.learned_ranges,
            arming_state=self.arming_state,
            countersignature=self.countersignature,
            fraction_arming=self.fraction_arming,
            is_reason_needed=self.is_reason_needed,
        )

    def picture(self):
        return None if self.latest is None else (self.latest.record.measurement.frame_index, self.latest.color)

    def note_presence(self, operator: str) -> None:
        self.present.append(operator)

    def report_fault(self, reason: HoldReason, detail: str) -> None:
        assert detail, "a fault says why"
        self.faults.append(reason)

    def stop(self) -> None:
        self.end()

    def evidence(self) -> dict[str, object]:
        return {}

    def end(self, *, error: str | None = None) -> None:
        if not self.status.is_over:
            self.transition(GateState.HOLD, HoldReason.ENGINE_STOPPED)
        self.run_state = LoopStatus.ENDED if error is None else LoopStatus.FAILED
        self.error = error

    def frame(self, *, whole_mm: float | None = 1.5, line_on: bool = False) -> FrameRecord:
        index = next(self._index)
        received_ns = 1_000_000_000 + index * FRAME_NS
        measurement = make_measurement(index, whole_mm=whole_mm, received_ns=received_ns)
        measurement = replace(measurement, breaths=self.breaths if whole_mm is not None else ())
        record = FrameRecord(
            measurement=measurement,
            gate_state=self.gate,
            hold_reason=None if self.gate is GateState.BEAM_ON else self.reason,
            signal_mm=whole_mm,
            received_ns=received_ns,
            decided_ns=received_ns + 4_000_000,
            asserted_ns=received_ns + 5_000_000 + index * 1_000,
            line_on=line_on,
            captured_ns=None if self.camera_ms is None else received_ns - int(self.camera_ms * 1e6),
        )
        self.samples.put_nowait(record)
        self.latest = LiveView(
            record=record,
            color=np.zeros((48, 64, 3), dtype=np.uint8),
            frames=index + 1,
            missed_frames=0,
            dropped_records=0,
            fps=29.97,
            latency=LatencySummary(last_ms=5.0, p50_ms=5.0, p99_ms=9.0, max_ms=31.0),
            is_armed=self.gate not in {GateState.DISARMED, GateState.FAULT},
            detail="",
            description=SourceDescription(
                kind="fake", name="fake", depth_size=(640, 480), color_size=(640, 480), fps=30.0, is_live=False
            ),
            status=self.run_state,
            error=None,
            window=self.window,
            conditions=self.conditions,
            operator_holds=self.operator_holds,
            armed_by=self.armed_by,
            breath_holds=max((state.holds for state in self.conditions), default=0),
            beam_on=self.beam_on,
            checks=self.checks,
        )
        return record

    def fault(self, reason: HoldReason) -> None:
        """Latch a fault, and show it with the next frame."""
        self.transition(GateState.FAULT, reason)
        self.reason = reason
        self.frame()

    def transition(
        self, to_state: GateState, reason: HoldReason | None = None, *, operator: str | None = None
    ) -> GateTransition:
        at_ns = 2_000_000_000
        made = GateTransition(
            at_ns=at_ns,
            frame_index=3,
            from_state=self.gate,
            to_state=to_state,
            reason=reason,
            operator=operator,
            detail="test",
            captured_us=100,
            received_ns=at_ns - 3,
            decided_ns=at_ns,
            asserted_ns=at_ns + 3,
            armed_by=self.armed_by,
        )
        self.gate = to_state
        self.transitions.put_nowait(made)
        return made


class FakeEngine:
    """Makes fake engines and keeps them for the test to drive."""

    is_simulated_beam = True
    trouble = None

    def __init__(self) -> None:
        self.opened: list[FakeRunning] = []
        self.fail_with: TidegateError | None = None
        self.broken_source: str | None = None
        self.probed: list[str | None] = []
        self.server_turned_ns: int | None = None
        self.while_probed: Callable[[], object] = lambda: None

    @property
    def running(self) -> FakeRunning:
        return self.opened[-1]

    def open(self, plan: SessionPlan) -> FakeRunning:
        if self.fail_with is not None:
            raise self.fail_with
        running = FakeRunning(plan)
        if self.broken_source is not None:
            running.end(error=self.broken_source)
        self.opened.append(running)
        return running

    def built_in_calibration(self, uri: str | None) -> Calibration:
        self.probed.append(uri)
        self.while_probed()
        if self.fail_with is not None:
            raise self.fail_with
        return nominal_calibration("Fake Xtion", size_px=(640, 480), field_of_view_rad=(1.02, 0.797))

    def note_server_turn(self, turned_ns: int) -> None:
        self.server_turned_ns = turned_ns

    def close(self) -> None:
        pass

    def devices(self) -> sessions.DeviceList:
        device = sessions.Device(uri="1d27/0601@1/2", name="Fake Xtion")
        return sessions.DeviceList(is_runtime_available=True, detail="", items=[device])


REFUSED = CommandRefusedError("no model yet")
TRAINING = TrainingProgress(frames=10, cycles=1, seconds=3.0, share=0.3)
