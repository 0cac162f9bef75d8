"""Takes each decision from its events to the line, and then to everybody who is told.

The order is the point: the gate is stepped, the line is told and read back, and only then are records made. Interlocks
(the watchdog, the recorder, the audit, a fault left by another thread, a person's hold, what stands against the beam
since the newest frame) are part of every decision.
"""

import math
import threading
from dataclasses import dataclass, replace

from engine.beam.witnessed import AskedLine
from engine.capture.source import SourceDescription
from engine.clock import NS_PER_MS, Clock
from engine.commands import Acknowledge, CorrectBaseline, Disarm, HoldBeam, ReleaseBeam
from engine.driver import BeamDriver, LineReport
from engine.errors import CommandRefusedError
from engine.frames import ColorImage, Measurement, MeasurementState, RgbdFrame
from engine.limits import GateLimits, ns_from_ms
from engine.live import FrameRecord, GateTransition, LiveView, LoopStatus
from engine.mailbox import Mailbox
from engine.outbox import Outbox
from engine.permits import GateState, HoldReason
from engine.presence import Presence
from engine.settled_window import SettledWindow, refuse_wide, window_text
from engine.stages.gate import Ending, Gate, GateEvent, Interruption, step_gate
from engine.tally import Tally
from engine.trust import captured_ns, too_slow
from engine.watchdog import Watchdog
from engine.windows import Ranges, signal_of
from engine.witness import NOBODY, Seam, Witness, WitnessedClock

BACK_DETAIL = "; it is back: acknowledge, set the reference, arm"
"""What a person is told of a lost camera that shows frames again."""

WATCHDOG_DETAIL = "the engine did not decide in time"
WATCHDOG_GONE = "the watchdog's thread has died"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Cause:
    """What a decision is made on: a frame, a person, or neither; what has a detail of its own is told in any case."""

    frame: RgbdFrame | None = None
    measurement: Measurement | None = None
    operator: str | None = None
    detail: str = ""


class GateKeeper:
    """Owns the gate; called by the engine thread, read by others."""

    def __init__(
        self,
        *,
        beam: AskedLine,
        clock: Clock,
        limits: GateLimits,
        outbox: Outbox,
        mailbox: Mailbox,
        watchdog: Watchdog,
        witness: Witness = NOBODY,
    ) -> None:
        self._witness = witness
        self._clock, self._limits = WitnessedClock(clock, witness), limits
        self._window = SettledWindow(told=limits.window, settled=limits.window)
        self._presence = Presence(clock=clock, timeout_s=limits.operator_timeout_s)
        self._operator_hold: str | None = None
        self._outbox, self._mailbox, self._watchdog = outbox, mailbox, watchdog
        self._driver = BeamDriver(beam=beam, clock=self._clock, limits=limits)
        self._tally = Tally(warn_latency_ms=limits.warn_latency_ms)
        self._latest: LiveView | None = None
        self._shown_by_watchdog: tuple[LiveView, LiveView] | None = None
        self._watchdog_told = threading.Lock()  # taken by whoever tells of it first: the watchdog, or the engine
        watchdog.on_fired = self._tell_watchdog
        self.gate = Gate(since_ns=self._clock.now_ns())
        self.standing: tuple[Interruption, ...] = ()
        self.status = LoopStatus.STARTING
        self.error: str | None = None
        self.description: SourceDescription | None = None

    def begin(self, description: SourceDescription) -> None:
        """Take over a source that was opened: what it is decides what the lag of its frames means."""
        self.description = description
        self._limits = replace(self._limits, is_played=not description.is_live)
        self.status = LoopStatus.RUNNING

    @property
    def latest(self) -> LiveView | None:
        """The newest view; one that a hung engine left behind is shown as the watchdog found it."""
        view = self._latest
        if view is None or not self._watchdog.has_fired or view.record.gate_state is GateState.FAULT:
            return view
        left_behind, shown = self._shown_by_watchdog or (None, None)
        if shown is None or view is not left_behind:  # one view for all who look: readers tell news by identity
            # The line was held, but nobody has read it back since: it may be on where it was on.
            record = replace(view.record, gate_state=GateState.FAULT, hold_reason=HoldReason.WATCHDOG)
            shown = replace(view, record=record, is_armed=False, detail=WATCHDOG_DETAIL)
            self._shown_by_watchdog = (view, shown)
        return shown

    def decide(self, *events: GateEvent, cause: Cause | None = None) -> None:
        """Step the gate through ``events`` to one decision, carry it out, and tell."""
        cause = cause or Cause()
        before = self.gate
        decided_ns = self._clock.now_ns()
        # Interlocks first, so that they are named as the cause; and last, so that no event clears them.
        interlocks = self._interlocks(decided_ns)
        gate = before
        for event in (*interlocks, *events, *interlocks):
            gate = step_gate(gate, event, decided_ns, self._limits)
        foreseen = self._foresee(before, gate, cause, decided_ns)
        report = self._driver.carry_out(gate, decided_ns)
        if report.trouble is not None:
            gate = step_gate(gate, self._named(report.trouble), decided_ns, self._limits)
        asserted_ns = self._clock.now_ns()
        slowness = self._slowness(gate, cause.measurement, asserted_ns)
        if slowness is not None:
            permitted, permitted_ns, gate = gate, asserted_ns, step_gate(gate, slowness, decided_ns, self._limits)
            report = self._driver.carry_out(gate, decided_ns)
            asserted_ns = self._clock.now_ns()
            if before.state is not GateState.BEAM_ON and permitted.state is GateState.BEAM_ON:
                # Told and held within one decision: the line was on meanwhile, and no beam-on is left off the record.
                told = self._transition(before, permitted, cause, decided_ns, permitted_ns)
                self._tell_transition(told, settles=foreseen)
                before, foreseen = permitted, None
        self.gate = gate
        self._watchdog.feed(decided_ns, is_armed=gate.is_armed)
        self._tell(before, cause, decided_ns, asserted_ns, report, foreseen)

    def acknowledge(self, command: Acknowledge) -> None:
        """Clear the latched fault for a named person; what still holds then faults again at once."""
        self._watchdog.reset()
        if self._watchdog_told.locked():
            self._watchdog_told.release()
        self.decide(command, cause=Cause(operator=command.operator))

    def disarm(self, command: Disarm) -> None:
        """Leave the decision to nobody; who held the beam by hand holds it no more."""
        self._operator_hold = None
        self.decide(command, cause=Cause(operator=command.operator))

    def hold(self, command: HoldBeam) -> None:
        """Hold until somebody releases; the first who held stays named."""
        self._operator_hold = self._operator_hold or command.operator
        self.decide(cause=Cause(operator=command.operator))

    def release(self, command: ReleaseBeam) -> None:
        """Let the gate decide again, after a full dwell."""
        if self._operator_hold is None:
            raise CommandRefusedError("nobody holds the beam by hand")
        self._operator_hold = None
        released = Interruption(HoldReason.DWELL, f"released by {command.operator}")
        self.decide(released, cause=Cause(operator=command.operator))

    def note_presence(self, operator: str) -> None:
        """Hear from a person's page, from any thread."""
        self._presence.note(operator)

    def watch_for(self, operator: str) -> None:
        """Watch for the person who arms."""
        self._presence.arm(operator)

    def refuse_wide_window(self) -> None:
        """Raise InvalidValueError where the window, as settled and corrected, lies beyond the site's limits."""
        refuse_wide(self._limits.window, self._limits)

    def correct_baseline(self, command: CorrectBaseline) -> None:
        """Disarm, then move the window; the audit hears of both windows even where nobody was armed."""
        corrected = self._window.corrected(command.by, self._limits)
        refuse_wide(corrected.window, self._limits)
        change = f"the window was {window_text(self._window.window)} and is {window_text(corrected.window)}"
        detail = f"the baseline is corrected by {command.by:g}: {change}"
        self.decide(Ending(HoldReason.DISARMED, detail), cause=Cause(operator=command.operator, detail=detail))
        self._decide_by(corrected)

    @property
    def correction(self) -> float:
        """How far the window was moved in all [mm, l of the volume]."""
        return self._window.correction

    def forget_correction(self) -> None:
        """Return to the window as told: motion is counted from a new zero."""
        self._decide_by(self._window.without_correction())

    def refuse_without_fresh_signal(self) -> None:
        """Raise CommandRefusedError unless the newest frame is fresh and its gated motion was measured."""
        view, last = self._latest, self.gate.last
        if view is None or last is None or view.record.measurement.state is not MeasurementState.MEASURING:
            raise CommandRefusedError("the newest frame was not measured: see that the patient is in view")
        if not self._is_signal_measured(view.record.measurement):
            raise CommandRefusedError("the gated motion is not measured: choose a region inside the grid")
        age_ms = (self._clock.now_ns() - last.received_ns) / NS_PER_MS
        if age_ms > self._limits.max_gap_ms + self._limits.max_frame_age_ms:
            raise CommandRefusedError(f"the newest frame is {age_ms:.0f} ms old: see to the camera")

    def finish(self, event: Ending | Interruption, status: LoopStatus, error: str | None) -> None:
        """Take the last decision; the line was held before this."""
        try:
            self.decide(event)
        finally:
            self.status, self.error = status, error
            if self._latest is not None:
                self._latest = replace(self._latest, status=status, error=error)

    def _interlocks(self, now_ns: int) -> list[Interruption]:
        self._outbox.flush()
        heard = self._witness.heard
        found = [] if not self._has_watchdog_fired() else [Interruption(HoldReason.WATCHDOG, WATCHDOG_DETAIL)]
        if self.gate.is_armed and not heard(Seam.WATCHDOG_WATCHES, lambda: self._watchdog.is_watching):
            found.append(Interruption(HoldReason.WATCHDOG, WATCHDOG_GONE))
        report = heard(Seam.REPORT, lambda: self._mailbox.take_report(is_armed=self.gate.is_armed))
        trouble = heard(Seam.QUEUES, self._outbox.trouble)
        found += [] if report is None else [report]
        found += [] if trouble is None else [Interruption(trouble, "a queue to the disk is full")]
        longest_ns = ns_from_ms(self._limits.max_unwritten_ms)
        delay = heard(Seam.DELAY, lambda: self._outbox.delay(now_ns, longest_ns)) if self.gate.is_armed else None
        found += [] if delay is None else [Interruption(*delay)]
        found += self.standing
        if not self._limits.is_calibrated:
            found.append(Interruption(HoldReason.CALIBRATION_MISSING, "nothing was measured for this camera"))
        absence = heard(Seam.ABSENCE, lambda: self._presence.silence(now_ns))
        found += [Interruption(HoldReason.OPERATOR_LOST, absence)] if absence else []
        leaver = heard(Seam.DISARM_ASKED, lambda: self._mailbox.disarm_asked_by)
        found += [] if leaver is None else [Interruption(HoldReason.DISARMED, f"{leaver} disarms")]
        holder = self._operator_hold or self._hold_asked_by()
        found += [] if holder is None else [Interruption(HoldReason.OPERATOR_HOLD, f"held by {holder}")]
        return found

    def _has_watchdog_fired(self) -> bool:
        return self._witness.heard(Seam.WATCHDOG_FIRED, lambda: self._watchdog.has_fired)

    def _hold_asked_by(self) -> str | None:
        return self._witness.heard(Seam.HOLD_ASKED, lambda: self._mailbox.hold_asked_by)

    def _slowness(self, gate: Gate, measurement: Measurement | None, asserted_ns: int) -> Interruption | None:
        """Fault where the line was told too late: only now is it known how long that took."""
        if measurement is None or gate.last is None:
            return None
        latency_ms = (asserted_ns - captured_ns(gate.last, measurement, self._limits)) / NS_PER_MS
        if latency_ms <= self._limits.max_latency_ms:
            return None
        return Interruption(HoldReason.LATENCY_HIGH, too_slow(latency_ms, self._limits))

    def _named(self, trouble: Interruption) -> Interruption:
        """Name the watchdog as the cause where its hold is why the line refused a permit."""
        return Interruption(HoldReason.WATCHDOG, WATCHDOG_DETAIL) if self._has_watchdog_fired() else trouble

    def _foresee(self, before: Gate, gate: Gate, cause: Cause, decided_ns: int) -> int | None:
        """Keep a permit where a kill does not reach it before the line hears of it; a hold waits for nothing."""
        if gate.state is not GateState.BEAM_ON or before.state is GateState.BEAM_ON:
            return None
        return self._outbox.foresee(self._transition(before, gate, cause, decided_ns, decided_ns))

    def _tell(
        self,
        before: Gate,
        cause: Cause,
        decided_ns: int,
        asserted_ns: int,
        report: LineReport,
        foreseen: int | None,
    ) -> None:
        gate, frame = self.gate, cause.frame
        is_news = (gate.state, gate.reason) != (before.state, before.reason)
        taken_ns = self._captured_ns(cause.measurement, gate)
        if cause.detail or (is_news and self._may_tell(gate)):
            told = self._transition(before, gate, cause, decided_ns, asserted_ns)
            self._tell_transition(told, settles=foreseen)
        elif foreseen is not None:
            self._outbox.forget(self._transition(before, gate, cause, decided_ns, asserted_ns), foreseen)
        if frame is not None and cause.measurement is not None:
            record = replace(
                self._record(cause.measurement, decided_ns, asserted_ns, is_on=report.is_on), captured_ns=taken_ns
            )
            self._outbox.put_sample(record)
            self._witness.told(record)
            self._tally.count(
                captured_ns=frame.received_ns if taken_ns is None else taken_ns,
                received_ns=frame.received_ns,
                asserted_ns=asserted_ns,
                missed_frames=frame.missed_frames,
            )
            is_back = gate.state is GateState.FAULT and gate.reason is HoldReason.SOURCE_LOST
            self._show(record, frame.color, gate.detail + BACK_DETAIL if is_back else gate.detail)
        elif self._latest is not None:
            record = replace(self._latest.record, gate_state=gate.state, hold_reason=gate.reason, line_on=report.is_on)
            self._show(record, self._latest.color, gate.detail)

    def _transition(self, before: Gate, gate: Gate, cause: Cause, decided_ns: int, asserted_ns: int) -> GateTransition:
        frame = cause.frame
        return GateTransition(
            at_ns=decided_ns,
            frame_index=None if frame is None else frame.index,
            from_state=before.state,
            to_state=gate.state,
            reason=gate.reason,
            operator=cause.operator or self._holder_of(gate),
            detail=cause.detail or gate.detail,
            captured_us=None if frame is None else frame.timestamp_us,
            received_ns=None if frame is None else frame.received_ns,
            decided_ns=decided_ns,
            asserted_ns=asserted_ns,
            captured_ns=self._captured_ns(cause.measurement, gate),
        )

    def _tell_transition(self, transition: GateTransition, *, settles: int | None = None) -> None:
        self._outbox.put_transition(transition, settles=settles)
        self._witness.told(transition)

    def _captured_ns(self, measurement: Measurement | None, gate: Gate) -> int | None:
        last = gate.last
        return None if measurement is None or last is None else captured_ns(last, measurement, self._limits)

    def _holder_of(self, gate: Gate) -> str | None:
        """Name who asked for a hold that a frame's decision has obeyed already."""
        is_held = gate.is_armed and gate.reason is HoldReason.OPERATOR_HOLD
        return self._operator_hold or self._hold_asked_by() if is_held else None

    def _may_tell(self, gate: Gate) -> bool:
        """Tell a fault of the watchdog once only: it does so itself while the engine hangs, else the engine does."""
        return gate.reason is not HoldReason.WATCHDOG or self._witness.heard(
            Seam.WATCHDOG_TOLD, lambda: self._watchdog_told.acquire(blocking=False)
        )

    def _record(self, measurement: Measurement, decided_ns: int, asserted_ns: int, *, is_on: bool) -> FrameRecord:
        return FrameRecord(
            measurement=measurement,
            gate_state=self.gate.state,
            hold_reason=self.gate.reason,
            signal_mm=self._signal_mm(measurement),
            received_ns=measurement.received_ns,
            decided_ns=decided_ns,
            asserted_ns=asserted_ns,
            line_on=is_on,
        )

    def _is_signal_measured(self, measurement: Measurement) -> bool:
        """Whether every signal the window looks at was measured."""
        motion = measurement.motion
        choices = self._limits.window.choices
        return motion is not None and all(math.isfinite(signal_of(choice, motion)) for choice in choices)

    def _signal_mm(self, measurement: Measurement) -> float | None:
        """Return the first gated signal; None where it was not measured, or is the volume."""
        choice = self._limits.window.choices[0]
        if measurement.motion is None or choice.is_volume:
            return None
        signal_mm = signal_of(choice, measurement.motion)
        return signal_mm if math.isfinite(signal_mm) else None

    def settle_window(self, ranges: Ranges) -> None:
        """Turn a window told in per cent into mm and l, now that the learned range and the reference are known."""
        self._decide_by(self._window.with_ranges(ranges))

    @property
    def is_window_unsettled(self) -> bool:
        """Whether a part of the window is still told in per cent."""
        return self._limits.window.needs_ranges

    def _decide_by(self, window: SettledWindow) -> None:
        self._window = window
        self._limits = replace(self._limits, window=window.window)

    def _show(self, record: FrameRecord, color: ColorImage, detail: str) -> None:
        if self.description is None:
            return
        self._latest = LiveView(
            record=record,
            color=color,
            frames=self._tally.frames,
            missed_frames=self._tally.missed_frames,
            dropped_records=self._outbox.dropped_records,
            fps=self._tally.fps,
            latency=self._tally.latency,
            is_armed=self.gate.is_armed,
            detail=detail,
            description=self.description,
            status=self.status,
            error=self.error,
            window=self._limits.window,
            conditions=self.gate.conditions,
            operator_hold=self._operator_hold,
            breath_holds=self.gate.breath_holds,
        )

    def _tell_watchdog(self, at_ns: int) -> None:
        """Tell what the watchdog did, from its own thread: the engine may never come back."""
        before = self.gate
        if not self._watchdog_told.acquire(blocking=False):
            return
        self._tell_transition(
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
            )
        )
