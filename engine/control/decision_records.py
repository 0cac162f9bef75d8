"""The records of each decision: journal, transitions, samples and the newest view.

Made after the line was driven; only the journal's entry of a permit is prepared before it. Nothing here waits, and
nothing here can change a decision.
"""

import threading

from engine.control.beam_driver import LineReport
from engine.control.live_views import LiveViews
from engine.control.output_queues import OutputQueues
from engine.control.outputs import Decision, FrameRecord, GateTransition
from engine.control.session_limits import SessionLimits
from engine.core.clock import Clock
from engine.core.frames import Measurement
from engine.core.gate_state import GateState, HoldReason
from engine.core.input_tap import NO_TAP, InputKind, InputTap
from engine.gating.gate import Gate
from engine.gating.interlocks import WATCHDOG_DETAIL


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
