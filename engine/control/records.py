"""The records of each decision: journal, transitions and samples, and the newest view and status for other threads.

Made after the line was driven; only the journal's entry of a permit is prepared before it. Nothing here waits, and
nothing here can change a decision. A view is a frozen value that is written by the engine thread and replaced whole;
one that a hung engine left behind is shown as a fault. The engine's status is another such value: what is known
between two frames.
"""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from engine.beam.beam_on import BeamOnState
from engine.capture.source import SourceDescription
from engine.control.arming import Arming, CountersignatureState
from engine.control.beam_driver import LineReport
from engine.control.output_queues import OutputQueues
from engine.control.outputs import Decision, FrameRecord, GateTransition, LatencySummary, LiveView, LoopStatus
from engine.control.session_state import SessionLimits
from engine.control.watchdog import Watchdog
from engine.core.clock import NS_PER_MS, NS_PER_S, Clock
from engine.core.fraction_arming import FractionArming
from engine.core.frames import ColorImage, Measurement, RgbdFrame
from engine.core.gate_state import GateState, HoldReason
from engine.core.input_tap import NO_TAP, InputKind, InputTap
from engine.core.learning_status import LearningStatus
from engine.core.position_check import CameraView
from engine.core.replacing import replace
from engine.core.sentences import listed, say
from engine.core.signals import Ranges
from engine.gating.delivery import is_age_known
from engine.gating.gate import Gate
from engine.gating.interlocks import WATCHDOG_DETAIL
from engine.gating.limits import GateLimits
from engine.gating.supervision.supervisor import FrameSupervisor

LATENCY_SAMPLES = 512

FRAMES_PER_SUMMARY = 8
"""Percentiles are computed once in this many frames: sorting at every frame would add latency."""

BACK_DETAIL = say("it is back: acknowledge, set the reference, arm")
"""Added to the detail of a lost camera that delivers frames again."""


class LatencyStatistics:
    """Running statistics; owned by the engine thread."""

    def __init__(self, *, warn_latency_ms: float) -> None:
        self._warn_latency_ms = warn_latency_ms
        self.frames = 0
        self.missed_frames = 0
        self._received_ns: deque[int] = deque()
        self._latencies_ms: deque[float] = deque(maxlen=LATENCY_SAMPLES)
        self._p50_ms = self._p99_ms = self._max_ms = 0.0

    def count(self, *, captured_ns: int, received_ns: int, asserted_ns: int, missed_frames: int) -> None:
        """Count one frame."""
        latency_ms = (asserted_ns - captured_ns) / NS_PER_MS
        self._latencies_ms.append(latency_ms)
        self._max_ms = max(self._max_ms, latency_ms)
        if self.frames % FRAMES_PER_SUMMARY == 0:
            p50_ms, p99_ms = np.percentile(self._latencies_ms, [50, 99])
            self._p50_ms, self._p99_ms = float(p50_ms), float(p99_ms)
        self.frames += 1
        self.missed_frames += max(missed_frames, 0)
        self._received_ns.append(received_ns)
        while received_ns - self._received_ns[0] > NS_PER_S:
            self._received_ns.popleft()

    @property
    def fps(self) -> float:
        """Frames a second over the last second; 0 until there are two."""
        span_ns = self._received_ns[-1] - self._received_ns[0] if self._received_ns else 0
        return 0.0 if span_ns <= 0 else (len(self._received_ns) - 1) * NS_PER_S / span_ns

    @property
    def latency(self) -> LatencySummary:
        """Latency of the last frame, of the last few hundred, and the longest so far."""
        last_ms = self._latencies_ms[-1] if self._latencies_ms else 0.0
        return LatencySummary(
            last_ms=last_ms,
            p50_ms=self._p50_ms,
            p99_ms=self._p99_ms,
            max_ms=self._max_ms,
            is_warned=last_ms > self._warn_latency_ms,
        )


def no_signal() -> BeamOnState | None:
    """Return None: the accelerator's beam-on signal is no input."""
    return None


def no_camera_view(_frame: RgbdFrame) -> CameraView | None:
    """Return None: how the camera looks is not measured."""
    return None


def _is_clock_checked(decision: Decision, limits: GateLimits) -> bool:
    """Whether the age of the newest frame is known by the camera's clock; that of a recording's frames is not."""
    last = decision.gate.last
    return not limits.is_played and last is not None and is_age_known(last.delivery, last.received_ns)


class LiveViews:
    """Makes the newest view from each decision.

    Attributes
    ----------
    newest
        As made at the last decision; None before the first frame.
    """

    def __init__(
        self,
        *,
        limits: SessionLimits,
        outputs: OutputQueues,
        watchdog: Watchdog,
        beam_on: Callable[[], BeamOnState | None] = no_signal,
        arming: Arming,
        supervisor: FrameSupervisor,
        camera_view: Callable[[RgbdFrame], CameraView | None] = no_camera_view,
    ) -> None:
        self._camera_view = camera_view
        self._newest_camera_view: CameraView | None = None
        self._beam_on, self._arming, self._supervisor = beam_on, arming, supervisor
        self._limits, self._outputs, self._watchdog = limits, outputs, watchdog
        self._latency = LatencyStatistics(warn_latency_ms=limits.current.warn_latency_ms)
        self._shown_by_watchdog: tuple[LiveView, LiveView] | None = None
        self.newest: LiveView | None = None
        self.run_state = LoopStatus.STARTING
        self.error: str | None = None
        self.description: SourceDescription | None = None

    def begin(self, description: SourceDescription) -> None:
        """Show a source that was opened."""
        self.description = description
        self.run_state = LoopStatus.RUNNING

    def end(self, run_state: LoopStatus, error: str | None) -> None:
        """Show how the engine ended."""
        self.run_state, self.error = run_state, error
        if self.newest is not None:
            self.newest = replace(self.newest, status=run_state, error=error)

    def shown(self, view: LiveView | None) -> LiveView | None:
        """Return ``view``; where the watchdog has fired and the engine has not decided since, as the watchdog's fault.

        Called from any thread.
        """
        if view is None or not self._watchdog.has_fired or view.record.gate_state is GateState.FAULT:
            return view
        left_behind, shown = self._shown_by_watchdog or (None, None)
        if shown is None or view is not left_behind:  # one view for all readers: they recognise a new one by identity
            # The line was held, but it has not been read back since: it may be on where it was on.
            record = replace(view.record, gate_state=GateState.FAULT, hold_reason=HoldReason.WATCHDOG)
            shown = replace(view, record=record, is_armed=False, armed_by=None, detail=WATCHDOG_DETAIL)
            self._shown_by_watchdog = (view, shown)
        return shown

    def show_frame(self, decision: Decision, record: FrameRecord, frame: RgbdFrame) -> None:
        """Count a frame that was decided on, and show it."""
        self._latency.count(
            captured_ns=frame.received_ns if record.captured_ns is None else record.captured_ns,
            received_ns=frame.received_ns,
            asserted_ns=record.asserted_ns,
            missed_frames=frame.missed_frames,
        )
        gate = decision.gate
        self._newest_camera_view = None if gate.is_armed else self._camera_view(frame)
        is_back = gate.state is GateState.FAULT and gate.reason is HoldReason.SOURCE_LOST
        detail = listed("; ", (gate.detail, BACK_DETAIL)) if is_back else gate.detail
        self._show(decision, record, frame.color, detail)

    def show_without_frame(self, decision: Decision, *, is_on: bool) -> None:
        """Show the last frame again, with the gate and the line of now."""
        view, gate = self.newest, decision.gate
        if view is not None:
            record = replace(view.record, gate_state=gate.state, hold_reason=gate.reason, line_on=is_on)
            self._show(decision, record, view.color, gate.detail)

    def _show(self, decision: Decision, record: FrameRecord, color: ColorImage, detail: str) -> None:
        if self.description is None:
            return
        motion, limits = record.measurement.motion, self._limits.current
        self.newest = LiveView(
            record=record,
            color=color,
            frames=self._latency.frames,
            missed_frames=self._latency.missed_frames,
            dropped_records=self._outputs.dropped_records,
            fps=self._latency.fps,
            latency=self._latency.latency,
            is_armed=decision.gate.is_armed,
            detail=detail,
            description=self.description,
            status=self.run_state,
            error=self.error,
            window=limits.window,
            conditions=decision.gate.conditions,
            operator_holds=decision.operator_holds,
            armed_by=decision.gate.armed_by,
            breath_holds=decision.gate.breath_holds,
            beam_on=self._beam_on(),
            reference_distance=self._arming.budget.present(),
            reference_budget_mm=limits.max_reference_distance_mm,
            movement=self._supervisor.movement,
            checks=self._supervisor.checks,
            marker_travel_mm=self._supervisor.marker_travel_mm,
            is_clock_checked=_is_clock_checked(decision, limits),
            position=self._arming.position.present(),
            camera_view=self._newest_camera_view,
            unseen_cells=() if motion is None else motion.seen.unseen_cells(limits.min_signal_share),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EngineStatus:
    """The state of an engine at the end of its last turn, or at its last answer to a command.

    Attributes
    ----------
    run_state
        Starting, running, ended or failed.
    error
        Why it failed, for a person; None where it did not.
    source
        The camera or recording, once it is open.
    view
        The newest view; None before the first frame.
    learning
        The model and the reference in use.
    predicted_duty_percent
        Share of the learned breaths inside the window, 0 to 100; None where it is not known, and for breath holds.
    learned_ranges
        Range of each signal of the window in the training, against the present reference; for display alone.
    arming_state
        Hash of what an arming would take: window, its correction and times, reference, model and head direction.
    is_reason_needed
        Whether a person has to arm, with a reason: conditions joined by or, or a window beyond the fraction's budget.
    countersignature
        Whether the next arming needs a second person, and who has signed what it would take.
    fraction_arming
        What the fraction was armed with, by this session or an earlier one; None where it was not.
    """

    run_state: LoopStatus = LoopStatus.STARTING
    error: str | None = None
    source: SourceDescription | None = None
    view: LiveView | None = None
    learning: LearningStatus = field(default_factory=LearningStatus)
    predicted_duty_percent: float | None = None
    learned_ranges: Ranges = field(default_factory=dict)
    arming_state: str = ""
    is_reason_needed: bool = False
    countersignature: CountersignatureState = field(default_factory=CountersignatureState)
    fraction_arming: FractionArming | None = None

    @property
    def is_over(self) -> bool:
        """Whether the engine decides nothing any more."""
        return self.run_state.is_over


class DecisionRecords:
    """Records decisions; transitions of the watchdog come from its own thread, all else from the engine's."""

    def __init__(
        self,
        *,
        clock: Clock,
        limits: SessionLimits,
        outputs: OutputQueues,
        views: LiveViews,
        tap: InputTap = NO_TAP,
    ) -> None:
        self._clock, self._limits, self._outputs = clock, limits, outputs
        self._views, self._tap = views, tap
        self._watchdog_recorded = threading.Lock()  # taken by the thread that records it first: watchdog or engine
        self.newest_measurement: Measurement | None = None
        """The measurement of the newest frame that was decided on; None before the first."""

    def prepare(self, decision: Decision) -> int | None:
        """Write a permit into the journal before the line is asked; return its number. A hold waits for nothing."""
        if decision.gate.state is not GateState.BEAM_ON or decision.before.state is GateState.BEAM_ON:
            return None
        return self._outputs.prepare(self._transition(decision))

    def record(self, decision: Decision, report: LineReport, prepared: int | None) -> None:
        """Record a decision that the line has carried out: its transition first, then its sample, then the view."""
        if decision.cause.detail or (decision.is_change and self._may_record(decision.gate)):
            self.record_transition(decision, prepared)
        elif prepared is not None:
            self._outputs.abort(self._transition(decision), prepared)
        frame, measurement = decision.cause.frame, decision.cause.measurement
        if frame is not None and measurement is not None:
            self.newest_measurement = measurement
            sample = self._sample(decision, measurement, is_on=report.is_on)
            self._outputs.put_sample(sample)
            self._tap.emit(sample)
            self._views.show_frame(decision, sample, frame)
        else:
            self._views.show_without_frame(decision, is_on=report.is_on)

    def record_transition(self, decision: Decision, prepared: int | None) -> None:
        """Record a change of the gate; ``prepared`` is the number under which the journal expects it."""
        self._put(self._transition(decision), prepared)

    def record_watchdog(self, before: Gate, at_ns: int) -> None:
        """Record that the watchdog held the line; from its thread, for the engine may hang."""
        if not self._watchdog_recorded.acquire(blocking=False):
            return
        self._put(
            GateTransition(
                at_ns=at_ns,
                frame_index=None,
                from_state=before.state,
                to_state=GateState.FAULT,
                reason=HoldReason.WATCHDOG,
                operator=None,
                detail=WATCHDOG_DETAIL,
                captured_us=None,
                received_ns=None,
                decided_ns=at_ns,
                asserted_ns=self._clock.now_ns(),
                armed_by=before.armed_by,
            ),
            None,
        )

    def expect_watchdog_again(self) -> None:
        """Record the watchdog's next fault too: the last one was acknowledged."""
        if self._watchdog_recorded.locked():
            self._watchdog_recorded.release()

    def _may_record(self, gate: Gate) -> bool:
        """Whether this change is still to be recorded: a fault of the watchdog is recorded by one thread only."""
        return gate.reason is not HoldReason.WATCHDOG or self._tap.observe(
            InputKind.WATCHDOG_RECORDED, lambda: self._watchdog_recorded.acquire(blocking=False)
        )

    def _put(self, transition: GateTransition, prepared: int | None) -> None:
        self._outputs.put_transition(transition, prepared=prepared)
        self._tap.emit(transition)

    def _transition(self, decision: Decision) -> GateTransition:
        gate, cause, frame = decision.gate, decision.cause, decision.cause.frame
        return GateTransition(
            at_ns=decision.decided_ns,
            frame_index=None if frame is None else frame.index,
            from_state=decision.before.state,
            to_state=gate.state,
            reason=gate.reason,
            operator=cause.operator or _holder_of(decision),
            detail=cause.detail or gate.detail,
            captured_us=None if frame is None else frame.timestamp_us,
            received_ns=None if frame is None else frame.received_ns,
            decided_ns=decision.decided_ns,
            asserted_ns=decision.asserted_ns,
            captured_ns=decision.captured_ns,
            armed_by=gate.armed_by or decision.before.armed_by,
        )

    def _sample(self, decision: Decision, measurement: Measurement, *, is_on: bool) -> FrameRecord:
        return FrameRecord(
            measurement=measurement,
            gate_state=decision.gate.state,
            hold_reason=decision.gate.reason,
            signal_mm=self._limits.signal_mm(measurement),
            received_ns=measurement.received_ns,
            decided_ns=decision.decided_ns,
            asserted_ns=decision.asserted_ns,
            line_on=is_on,
            captured_ns=decision.captured_ns,
        )


def _holder_of(decision: Decision) -> str | None:
    """Name the operator of a hold by hand that took effect at a frame's decision."""
    return decision.holder if decision.gate.reason is HoldReason.OPERATOR_HOLD else None
