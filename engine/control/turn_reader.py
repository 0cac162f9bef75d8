"""Reads everything outside the engine thread that a turn depends on, as values that a tape records (ADR 0016).

Each value is read at its own moment: a stop, a disarm or a hold that is requested while a frame is measured counts at
that frame's decision, and the time of a decision includes the time that measuring took.

What the engine thread reads in one turn, as values (ADR 0016).

A turn reads one :class:`TurnInputs`, one :class:`CommandInputs` for each command, at most one :class:`FrameInput`, and
for each decision one :class:`engine.gating.interlocks.DecisionInputs` and a :class:`LineAnswer` for each order to the
line. Tapes omit defaults, so they must never change.
"""

import threading
from dataclasses import dataclass

from engine.capture.source import DepthSource
from engine.control.command_queue import CommandQueue, QueuedCommand
from engine.control.output_queues import OutputQueues
from engine.control.session_limits import SessionLimits
from engine.control.watchdog import Watchdog
from engine.core.clock import NS_PER_MS, NS_PER_S, Clock
from engine.core.commands import Arm
from engine.core.errors import FrameTimeoutError, SourceAwayError
from engine.core.frames import RgbdFrame
from engine.core.gate_state import HoldReason
from engine.core.input_tap import NO_TAP, InputKind, InputTap
from engine.gating.gate import Gate
from engine.gating.interlocks import DecisionInputs
from engine.gating.limits import ns_from_ms
from engine.gating.supervision.operator_presence import OperatorPresence

SHORTEST_READ_NS = NS_PER_MS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TurnInputs:
    """Read at the start of a turn: whether the engine is to stop, and the commands that wait. A stop takes none."""

    is_stop_requested: bool = False
    commands: tuple[QueuedCommand, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandInputs:
    """Read when a command's turn has come.

    Attributes
    ----------
    is_wanted
        Whether the caller still waits for the answer.
    is_watchdog_running
        Whether the watchdog's thread is alive.
    queue_trouble
        Why a queue to the disk stands against the beam.
    operator_absence
        That no person who may arm is present, for a program that arms; empty otherwise.
    """

    is_wanted: bool = True
    is_watchdog_running: bool = True
    queue_trouble: HoldReason | None = None
    operator_absence: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameInput:
    """The source's answer: a frame, or none in time.

    Attributes
    ----------
    away
        Why the camera delivers none; None where it was only too late.
    at_ns
        When the source answered [ns, host monotonic].
    """

    frame: RgbdFrame | None = None
    away: str | None = None
    at_ns: int


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LineAnswer:
    """The beam line's answer to one order.

    Attributes
    ----------
    is_on
        As read back after the order; True where it was not, since the line may be on.
    is_settling
        Whether the order may not have taken effect yet.
    error
        What the line raised.
    watchdog_fired
        Whether the watchdog has held the line: then that is why it refuses a permit.
    at_ns
        When the line had answered [ns, host monotonic].
    """

    is_on: bool = True
    is_settling: bool = False
    error: Exception | None = None
    watchdog_fired: bool = False
    at_ns: int


class TurnReader:
    """Reads the inputs of turns; owned by the engine thread.

    Parameters
    ----------
    clock
        The host's clock; the tap records its readings as part of the values.
    """

    def __init__(
        self,
        *,
        source: DepthSource,
        clock: Clock,
        limits: SessionLimits,
        commands: CommandQueue,
        outputs: OutputQueues,
        watchdog: Watchdog,
        presence: OperatorPresence,
        stop_requested: threading.Event,
        tap: InputTap = NO_TAP,
    ) -> None:
        self._source, self._clock, self._limits, self._tap = source, clock, limits, tap
        self._commands, self._outputs, self._watchdog = commands, outputs, watchdog
        self._presence, self._stop_requested = presence, stop_requested

    def turn(self) -> TurnInputs:
        """Read whether the engine is to stop, and take the commands that wait."""
        return self._tap.observe(InputKind.TURN, self._read_turn)

    def command(self, queued: QueuedCommand) -> CommandInputs:
        """Read what a command depends on; from now on its caller cannot cancel it."""
        return self._tap.observe(InputKind.COMMAND, lambda: self._read_command(queued))

    def frame(self, *, last_received_ns: int | None) -> FrameInput:
        """Wait for the next frame, until it is late against the arrival of the last one [ns].

        Raises
        ------
        TidegateError
            The source has ended, or is lost.
        """
        return self._tap.observe(InputKind.FRAME, lambda: self._read_frame(last_received_ns))

    def decision(self, gate: Gate) -> DecisionInputs:
        """Read what a decision depends on besides its events, now; some only while the gate is armed."""
        return self._tap.observe(InputKind.DECISION, lambda: self._read_decision(gate))

    def _read_turn(self) -> TurnInputs:
        if self._stop_requested.is_set():
            return TurnInputs(is_stop_requested=True)
        return TurnInputs(commands=tuple(self._commands.take()))

    def _read_command(self, queued: QueuedCommand) -> CommandInputs:
        return CommandInputs(
            is_wanted=queued.answer.set_running_or_notify_cancel(),
            is_watchdog_running=self._watchdog.is_watching,
            queue_trouble=self._outputs.trouble(),
            operator_absence=self._presence.absence_of_all(self._clock.now_ns()) if _arms_by_program(queued) else "",
        )

    def _read_frame(self, last_received_ns: int | None) -> FrameInput:
        frame, away = None, None
        try:
            frame = self._source.read(self._timeout_ns(last_received_ns) / NS_PER_S)
        except SourceAwayError as error:
            away = str(error)
        except FrameTimeoutError:
            pass
        return FrameInput(frame=frame, away=away, at_ns=self._clock.now_ns())

    def _timeout_ns(self, last_received_ns: int | None) -> int:
        """Return the time left until the next frame is late [ns]."""
        longest_ns = ns_from_ms(self._limits.current.max_gap_ms)
        left_ns = longest_ns if last_received_ns is None else last_received_ns + longest_ns - self._clock.now_ns()
        return left_ns if SHORTEST_READ_NS <= left_ns <= longest_ns else longest_ns

    def _read_decision(self, gate: Gate) -> DecisionInputs:
        self._outputs.flush()
        is_stop_requested = self._stop_requested.is_set()
        now_ns = self._clock.now_ns()
        longest_ns = ns_from_ms(self._limits.current.max_unwritten_ms)
        return DecisionInputs(
            at_ns=now_ns,
            watchdog_fired=self._watchdog.has_fired,
            is_watchdog_running=self._watchdog.is_watching,
            reported_fault=self._commands.take_report(is_armed=gate.is_armed),
            queue_trouble=self._outputs.trouble(),
            write_delay=self._outputs.delay(now_ns, longest_ns) if gate.is_armed else None,
            operator_absence=self._presence.absence(gate, now_ns),
            disarm_requested_by=self._commands.disarm_requested_by,
            hold_requested_by=self._commands.hold_requested_by,
            is_stop_requested=is_stop_requested,
        )


def _arms_by_program(queued: QueuedCommand) -> bool:
    return isinstance(queued.command, Arm) and not queued.command.is_person
