"""The interlocks of one decision: everything outside the frame itself that stands against the beam.

Read by the engine thread, once for each decision, from the watchdog, the queues to the disk, the command queue, the
frame supervisor and the operator's presence. Nothing here can permit a beam: every finding holds or faults.
"""

from engine.control.command_queue import CommandQueue
from engine.control.output_queues import OutputQueues
from engine.control.session_limits import SessionLimits
from engine.control.watchdog import Watchdog
from engine.core.clock import Clock
from engine.core.gate_state import HoldReason
from engine.core.input_tap import NO_TAP, InputKind, InputTap
from engine.gating.gate import Gate, Interruption
from engine.gating.limits import ns_from_ms
from engine.gating.supervision.operator_presence import OperatorPresence

WATCHDOG_DETAIL = "the engine did not decide in time"
WATCHDOG_GONE = "the watchdog's thread has died"


class InterlockInputs:
    """Collects the interlocks.

    Attributes
    ----------
    supervision
        What the newest frames show against the beam; set by the loop before each decision on a frame.
    operator_hold
        The operator who holds the beam by hand; None where there is none.
    """

    def __init__(
        self,
        *,
        clock: Clock,
        limits: SessionLimits,
        outputs: OutputQueues,
        commands: CommandQueue,
        watchdog: Watchdog,
        tap: InputTap = NO_TAP,
    ) -> None:
        self._limits, self._outputs, self._commands, self._watchdog = limits, outputs, commands, watchdog
        self._tap = tap
        self._presence = OperatorPresence(clock=clock, timeout_s=limits.current.operator_timeout_s)
        self.supervision: tuple[Interruption, ...] = ()
        self.operator_hold: str | None = None

    def collect(self, gate: Gate, now_ns: int) -> list[Interruption]:
        """Return everything that stands against the beam at ``now_ns`` (host monotonic), the watchdog first."""
        self._outputs.flush()
        found = [
            *self._watchdog_interlocks(gate),
            *self._queue_interlocks(gate, now_ns),
            *self.supervision,
        ]
        if not self._limits.current.is_calibrated:
            found.append(Interruption(HoldReason.CALIBRATION_MISSING, "nothing was measured for this camera"))
        return found + self._operator_interlocks(now_ns)

    def has_watchdog_fired(self) -> bool:
        """Whether the watchdog has held the line, without an acknowledgement since."""
        return self._tap.observe(InputKind.WATCHDOG_FIRED, lambda: self._watchdog.has_fired)

    def holder(self) -> str | None:
        """Name the operator who holds the beam by hand, or whose hold waits in the command queue."""
        return self.operator_hold or self._tap.observe(
            InputKind.HOLD_REQUESTED, lambda: self._commands.hold_requested_by
        )

    def note_presence(self, operator: str) -> None:
        """Note that this operator's page is open; from any thread, never waits."""
        self._presence.note(operator)

    def expect_presence(self, operator: str) -> None:
        """Expect signs of presence from this operator from now on: they arm."""
        self._presence.arm(operator)

    def _watchdog_interlocks(self, gate: Gate) -> list[Interruption]:
        found = [Interruption(HoldReason.WATCHDOG, WATCHDOG_DETAIL)] if self.has_watchdog_fired() else []
        if gate.is_armed and not self._tap.observe(InputKind.WATCHDOG_RUNS, lambda: self._watchdog.is_watching):
            found.append(Interruption(HoldReason.WATCHDOG, WATCHDOG_GONE))
        return found

    def _queue_interlocks(self, gate: Gate, now_ns: int) -> list[Interruption]:
        """Return a reported fault, a full queue, and, while armed, what waits for the disk too long."""
        observe = self._tap.observe
        report = observe(InputKind.REPORTED_FAULT, lambda: self._commands.take_report(is_armed=gate.is_armed))
        trouble = observe(InputKind.QUEUE_TROUBLE, self._outputs.trouble)
        longest_ns = ns_from_ms(self._limits.current.max_unwritten_ms)
        delay = (
            observe(InputKind.WRITE_DELAY, lambda: self._outputs.delay(now_ns, longest_ns)) if gate.is_armed else None
        )
        found = [] if report is None else [report]
        found += [] if trouble is None else [Interruption(trouble, "a queue to the disk is full")]
        found += [] if delay is None else [Interruption(*delay)]
        return found

    def _operator_interlocks(self, now_ns: int) -> list[Interruption]:
        absence = self._tap.observe(InputKind.OPERATOR_ABSENCE, lambda: self._presence.silence(now_ns))
        found = [Interruption(HoldReason.OPERATOR_LOST, absence)] if absence else []
        leaver = self._tap.observe(InputKind.DISARM_REQUESTED, lambda: self._commands.disarm_requested_by)
        found += [] if leaver is None else [Interruption(HoldReason.DISARMED, f"{leaver} disarms")]
        holder = self.holder()
        found += [] if holder is None else [Interruption(HoldReason.OPERATOR_HOLD, f"held by {holder}")]
        return found
