"""The interlocks of one decision: everything outside the frame itself that stands against the beam.

What they are decided on is one frozen value, read by :class:`engine.control.turn_inputs.TurnReader`. Nothing here can
permit a beam: every finding holds or faults.

Presence of a person at the page, by the messages that it repeats, is one of them (ADR 0024). An armed gate needs a
person who sees the page and can hold: the person who armed it or released a hold since; where a program armed it, any
person who may arm. The service's threads write, and only for such persons; the engine thread reads. Every attribute is
written in one step, so no thread waits.
"""

from collections.abc import Iterable
from dataclasses import dataclass

from engine.core.clock import NS_PER_S, Clock
from engine.core.gate_state import HoldReason
from engine.core.sentences import say
from engine.gating.gate import Gate, Interruption
from engine.gating.limits import GateLimits

WATCHDOG_DETAIL = say("the engine did not decide in time")

WATCHDOG_GONE = say("the watchdog's thread has died")

QUEUE_FULL = say("a queue to the disk is full")

NOT_CALIBRATED = say("nothing was measured for this camera")

MOST_PERSONS = 256
"""More persons than any site has at its pages; beyond that all are forgotten, which holds the beam."""

NO_PERSON = say("no person who may arm is at the page")


@dataclass(frozen=True, slots=True, kw_only=True)
class DecisionInputs:
    """What was read for one decision, after its frame was measured. Tapes omit defaults, so they must never change.

    Attributes
    ----------
    at_ns
        Time of the decision [ns, host monotonic].
    watchdog_fired
        Whether the watchdog has held the line, without an acknowledgement since.
    is_watchdog_running
        Whether the watchdog's thread is alive.
    reported_fault
        A fault that another thread reported; while armed, the silence of the service is one.
    queue_trouble
        Why a queue to the disk stands against the beam.
    write_delay
        What has waited too long for the disk, and its text; read while armed only.
    operator_absence
        Who has to be present at the page and is not; empty where there is nobody.
    disarm_requested_by, hold_requested_by
        Operators whose disarm or hold waits in the command queue.
    is_stop_requested
        Whether the engine is to stop.
    """

    at_ns: int
    watchdog_fired: bool = False
    is_watchdog_running: bool = True
    reported_fault: Interruption | None = None
    queue_trouble: HoldReason | None = None
    write_delay: tuple[HoldReason, str] | None = None
    operator_absence: str = ""
    disarm_requested_by: str | None = None
    hold_requested_by: str | None = None
    is_stop_requested: bool = False


def interlocks(
    inputs: DecisionInputs,
    *,
    is_armed: bool,
    limits: GateLimits,
    supervision: Iterable[Interruption] = (),
    operator_hold: str | None = None,
) -> list[Interruption]:
    """Return everything that stands against the beam, in order of precedence: the watchdog first.

    Parameters
    ----------
    is_armed
        Whether the gate was armed before this decision.
    supervision
        What the newest frames show against the beam.
    operator_hold
        The operator who holds the beam by hand.
    """
    found = [*_of_the_engine(inputs, is_armed=is_armed), *supervision]
    if not limits.is_calibrated:
        found.append(Interruption(HoldReason.CALIBRATION_MISSING, NOT_CALIBRATED))
    return found + _of_the_operator(inputs, operator_hold or inputs.hold_requested_by)


def _of_the_engine(inputs: DecisionInputs, *, is_armed: bool) -> list[Interruption]:
    """Return the interlocks of the watchdog, of reported faults, and of the queues to the disk."""
    found = []
    if inputs.watchdog_fired:
        found.append(Interruption(HoldReason.WATCHDOG, WATCHDOG_DETAIL))
    if is_armed and not inputs.is_watchdog_running:
        found.append(Interruption(HoldReason.WATCHDOG, WATCHDOG_GONE))
    if inputs.reported_fault is not None:
        found.append(inputs.reported_fault)
    if inputs.queue_trouble is not None:
        found.append(Interruption(inputs.queue_trouble, QUEUE_FULL))
    if inputs.write_delay is not None:
        found.append(Interruption(*inputs.write_delay))
    return found


def _of_the_operator(inputs: DecisionInputs, holder: str | None) -> list[Interruption]:
    found = []
    if inputs.operator_absence:
        found.append(Interruption(HoldReason.OPERATOR_LOST, inputs.operator_absence))
    if inputs.disarm_requested_by is not None:
        found.append(
            Interruption(
                HoldReason.DISARMED,
                say("{disarm_requested_by} disarms", disarm_requested_by=inputs.disarm_requested_by),
            )
        )
    if holder is not None:
        found.append(Interruption(HoldReason.OPERATOR_HOLD, say("held by {holder}", holder=holder)))
    return found


class OperatorPresence:
    """Times of the persons' newest messages; a ``timeout_s`` of 0 switches the check off."""

    def __init__(self, *, clock: Clock, timeout_s: float) -> None:
        self._clock = clock
        self._timeout_ns = int(timeout_s * NS_PER_S)
        self._seen_ns: dict[str, int] = {}
        self._any_person_ns: int | None = None

    def note(self, person: str) -> None:
        """Note a message of a person who may arm, from any thread; arming and releasing count as one."""
        now_ns = self._clock.now_ns()
        if person not in self._seen_ns and len(self._seen_ns) >= MOST_PERSONS:
            self._seen_ns = {}
        self._seen_ns[person] = now_ns
        self._any_person_ns = now_ns

    def absence(self, gate: Gate, now_ns: int) -> str:
        """Return who has to be present for an armed gate and is not; empty otherwise."""
        if gate.armed_by is None:
            return ""
        if gate.is_armed_by_program:
            return self.absence_of_all(now_ns)
        seen_ns = self._seen_ns.get(gate.armed_by)
        if not self._is_silent(seen_ns, now_ns):
            return ""
        if seen_ns is None:
            return say("no message from {armed_by}", armed_by=gate.armed_by)
        silent_s = (now_ns - seen_ns) / NS_PER_S
        return say("no message from {armed_by} for {silent_s:.1f} s", armed_by=gate.armed_by, silent_s=silent_s)

    def absence_of_all(self, now_ns: int) -> str:
        """Return that no person who may arm is present; empty where one is."""
        return NO_PERSON if self._is_silent(self._any_person_ns, now_ns) else ""

    def _is_silent(self, seen_ns: int | None, now_ns: int) -> bool:
        """Whether the newest message is older than the timeout, or there was none."""
        if self._timeout_ns <= 0:
            return False
        return seen_ns is None or now_ns - seen_ns > self._timeout_ns
