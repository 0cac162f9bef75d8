"""Decides whether the beam may be on: steps the gate, drives the line, then has the decision recorded.

The order is the safety argument: the gate is stepped, the line is driven and read back, and only then are records made.
The interlocks are part of every decision, before and after its events.
"""

import math

from engine.control.beam_driver import BeamDriver, LineOrders, LineReport
from engine.control.outputs import Cause, Decision
from engine.control.records import DecisionRecords
from engine.control.session_state import SessionLimits
from engine.control.turn_inputs import TurnReader
from engine.control.watchdog import Watchdog
from engine.core.breath import SignalChoice
from engine.core.clock import NS_PER_MS, Clock
from engine.core.commands import Acknowledge, CorrectBaseline, Disarm, HoldBeam, ReleaseBeam
from engine.core.errors import CommandRefusedError
from engine.core.frames import LostReason, Measurement, MeasurementState, RoomChange
from engine.core.gate_state import GateState, HoldReason
from engine.core.replacing import replace
from engine.core.sentences import listed, say
from engine.core.signals import Ranges
from engine.gating.active_window import SetWindow, window_text
from engine.gating.frame_checks import captured_ns, too_slow
from engine.gating.gate import Ending, Gate, GateEvent, Interruption, step_gate
from engine.gating.interlocks import WATCHDOG_DETAIL, DecisionInputs, interlocks
from engine.gating.windows import rescaled

DOUBTED = {LostReason.RESIDUAL_HIGH, LostReason.SURFACE_CHANGED}
"""Losses of a frame in which patient and markers are seen, and the surface is not believed."""


class GateController:
    """Owns the gate; called by the engine thread, read by others.

    Parameters
    ----------
    clock
        The engine thread's clock, whose readings a tape records.

    Attributes
    ----------
    gate
        As of the last decision.
    operator_hold
        The operator who holds the beam by hand; None where there is none.
    """

    def __init__(
        self,
        *,
        reader: TurnReader,
        line: LineOrders,
        clock: Clock,
        limits: SessionLimits,
        records: DecisionRecords,
        watchdog: Watchdog,
    ) -> None:
        self._clock, self._limits, self._watchdog = clock, limits, watchdog
        self._reader, self._records = reader, records
        self._driver = BeamDriver(line=line, clock=clock, limits=limits.current)
        watchdog.on_fired = lambda at_ns: records.record_watchdog(self.gate, at_ns)
        self.gate = Gate(since_ns=clock.now_ns())
        self._supervision: tuple[Interruption, ...] = ()
        self._holds: list[str] = []

    def decide(
        self, *events: GateEvent, cause: Cause | None = None, supervision: tuple[Interruption, ...] | None = None
    ) -> None:
        """Step the gate through ``events`` to one decision, drive the line, and record it.

        ``supervision`` is what the newest frames show against the beam; without one the last stands.
        """
        cause = cause or Cause()
        if supervision is not None:
            self._supervision = supervision
        before = self.gate
        inputs = self._reader.decision(before)
        if inputs.is_stop_requested and cause.frame is not None:  # requested while this frame was measured
            events = (*events, Ending(HoldReason.ENGINE_STOPPED))
        gate = self._decided(before, events, inputs)
        prepared = self._records.prepare(self._decision(before, gate, cause, inputs, inputs.at_ns))
        report = self._driver.carry_out(gate, inputs.at_ns)
        if report.trouble is not None:
            gate = self._step(gate, _named(report.trouble, report), inputs.at_ns)
        slowness = self._slowness(gate, cause.measurement, report.asserted_ns)
        if slowness is not None:
            permitted, permitted_ns, gate = gate, report.asserted_ns, self._step(gate, slowness, inputs.at_ns)
            report = self._driver.carry_out(gate, inputs.at_ns)
            if before.state is not GateState.BEAM_ON and permitted.state is GateState.BEAM_ON:
                # Permitted and held within one decision: the line was on meanwhile, and every beam-on is recorded.
                self._records.record_transition(
                    self._decision(before, permitted, cause, inputs, permitted_ns), prepared
                )
                before, prepared = permitted, None
        self.gate = gate
        self._watchdog.feed(inputs.at_ns, is_armed=gate.is_armed)
        self._records.record(self._decision(before, gate, cause, inputs, report.asserted_ns), report, prepared)

    def _decided(self, before: Gate, events: tuple[GateEvent, ...], inputs: DecisionInputs) -> Gate:
        """Step the gate: interlocks first, to be named as the cause; and last, so that no event clears them."""
        standing = interlocks(
            inputs,
            is_armed=before.is_armed,
            limits=self._limits.current,
            supervision=self._supervision,
            operator_hold=self.operator_hold,
        )
        gate = before
        for event in (*standing, *events, *standing):
            gate = self._step(gate, event, inputs.at_ns)
        return gate

    def acknowledge(self, command: Acknowledge) -> None:
        """Clear the latched fault for a named person; a cause that persists faults again at once."""
        self._watchdog.reset()
        self._records.expect_watchdog_again()
        self.decide(command, cause=Cause(operator=command.operator))

    @property
    def operator_hold(self) -> str | None:
        """Who holds by hand; the first of several."""
        return next(iter(self._holds), None)

    @property
    def operator_holds(self) -> tuple[str, ...]:
        """All who hold by hand, in the order of their holds."""
        return tuple(self._holds)

    def disarm(self, command: Disarm) -> None:
        """Disarm; the operator's own hold by hand ends with it, that of another person stands."""
        self._end_hold(command.operator)
        self.decide(command, cause=Cause(operator=command.operator))

    def hold(self, command: HoldBeam) -> None:
        """Hold until the operator releases, or for a person's hold another person; the first who held stays named."""
        if command.operator not in self._holds:
            self._holds.append(command.operator)
        self.decide(cause=Cause(operator=command.operator))

    def release(self, command: ReleaseBeam) -> None:
        """End the operator's own hold; where a person has none, those of all others (ADR 0046).

        The beam is on again after a full dwell at the earliest.
        """
        if not self._holds:
            raise CommandRefusedError(say("no operator holds the beam"))
        if command.operator in self._holds:
            self._end_hold(command.operator)
        elif command.is_person:
            self._holds = []
        else:
            raise CommandRefusedError(
                say("held by {holds}: a program ends only its own hold", holds=listed(", ", self._holds))
            )
        self.decide(command, cause=Cause(operator=command.operator))

    def _end_hold(self, operator: str) -> None:
        self._holds = [one for one in self._holds if one != operator]

    def correct_baseline(self, command: CorrectBaseline) -> None:
        """Disarm, then move the window; both windows are recorded even where the gate was not armed."""
        before, corrected = self._limits.current.window, self._limits.corrected(command.by)
        change = say(
            "the window was {before} and is {window}", before=window_text(before), window=window_text(corrected.window)
        )
        detail = say("the baseline is corrected by {by:g}: {change}", by=command.by, change=change)
        self.decide(Ending(HoldReason.DISARMED, detail), cause=Cause(operator=command.operator, detail=detail))
        self._limits.use(corrected)

    def refuse_window_while_armed(self) -> None:
        """Raise CommandRefusedError while the gate is armed."""
        if self.gate.is_armed:
            raise CommandRefusedError(say("the gate is armed: disarm it before its window is set"))

    def set_window(self, command: SetWindow, ranges: Ranges) -> None:
        """Gate by another window; refused while the gate is armed. Both windows are recorded."""
        self.refuse_window_while_armed()
        change = self._limits.changed(command, ranges)
        before, after = self._limits.current.window, change.limits.window
        detail = say("the window was {before} and is {after}", before=window_text(before), after=window_text(after))
        self.decide(Ending(HoldReason.DISARMED, detail), cause=Cause(operator=command.operator, detail=detail))
        self._limits.use_change(change)

    def rescale(self) -> None:
        """Note that motion counts from another reference, or is measured with another model: no breath, and no end."""
        self.gate = replace(self.gate, conditions=rescaled(self.gate.conditions))

    def refuse_without_fresh_signal(self) -> None:
        """Raise CommandRefusedError unless the newest frame is fresh and its gated motion was measured."""
        received_ns = self.refuse_without_signal()
        doubt = None if self._records.newest_measurement is None else self._records.newest_measurement.doubt
        if doubt is not None:
            raise CommandRefusedError(doubt.detail)
        age_ms = (self._clock.now_ns() - received_ns) / NS_PER_MS
        if age_ms > self._limits.current.max_gap_ms + self._limits.current.max_frame_age_ms:
            raise CommandRefusedError(say("the newest frame is {age_ms:.0f} ms old: see to the camera", age_ms=age_ms))

    def refuse_without_signal(self) -> int:
        """Return when the newest frame was received [ns]; raise CommandRefusedError where it shows no gated motion."""
        measurement, last = self._records.newest_measurement, self.gate.last
        if measurement is None or last is None or measurement.state is not MeasurementState.MEASURING:
            raise CommandRefusedError(say("the newest frame was not measured: see that the patient is in view"))
        if not self._limits.is_signal_measured(measurement):
            raise CommandRefusedError(say("the gated motion is not measured: choose a region inside the grid"))
        unseen = self._limits.unseen_signal(measurement)
        if unseen is not None:
            raise CommandRefusedError(
                say("the camera does not see the gated motion ({unseen}): uncover it", unseen=unseen)
            )
        return last.received_ns

    def refuse_unseen_patient(self) -> None:
        """Raise CommandRefusedError where the newest frame shows no gated motion, and is not lost for doubt alone.

        A surface that moved as no skin can is doubted until a person sets the reference: so that has to be possible. It
        is taken up by a measured frame only.
        """
        measurement = self._records.newest_measurement
        lost = None if measurement is None else measurement.lost
        if lost is None or lost.reason not in DOUBTED:
            self.refuse_without_signal()

    @property
    def room_change(self) -> RoomChange | None:
        """How couch or camera have moved since the reference, by the newest frame; None where neither has."""
        measurement = self._records.newest_measurement
        lost = None if measurement is None else measurement.reason
        return None if lost is None else lost.moved

    def newest_level(self, choice: SignalChoice) -> float | None:
        """Return the signal in the newest frame [mm, l of the volume]; None where it was not measured."""
        measurement = self._records.newest_measurement
        level = math.nan
        if measurement is not None and measurement.motion is not None:
            level = choice.value_in(measurement.motion)
        return level if math.isfinite(level) else None

    def _step(self, gate: Gate, event: GateEvent, decided_ns: int) -> Gate:
        return step_gate(gate, event, decided_ns, self._limits.current)

    def _decision(self, before: Gate, gate: Gate, cause: Cause, inputs: DecisionInputs, asserted_ns: int) -> Decision:
        return Decision(
            cause=cause,
            before=before,
            gate=gate,
            decided_ns=inputs.at_ns,
            asserted_ns=asserted_ns,
            captured_ns=self._captured_ns(gate, cause.measurement),
            operator_holds=self.operator_holds,
            holder=self.operator_hold or inputs.hold_requested_by,
        )

    def _captured_ns(self, gate: Gate, measurement: Measurement | None) -> int | None:
        last = gate.last
        return None if measurement is None or last is None else captured_ns(last, measurement, self._limits.current)

    def _slowness(self, gate: Gate, measurement: Measurement | None, asserted_ns: int) -> Interruption | None:
        """Return a fault where the line was driven too late: only now is it known how long that took."""
        taken_ns = self._captured_ns(gate, measurement)
        if taken_ns is None:
            return None
        latency_ms = (asserted_ns - taken_ns) / NS_PER_MS
        if latency_ms <= self._limits.current.max_latency_ms:
            return None
        return Interruption(HoldReason.LATENCY_HIGH, too_slow(latency_ms, self._limits.current))


def _named(trouble: Interruption, report: LineReport) -> Interruption:
    """Name the watchdog as the cause where its hold is why the line refused a permit."""
    return Interruption(HoldReason.WATCHDOG, WATCHDOG_DETAIL) if report.watchdog_fired else trouble
