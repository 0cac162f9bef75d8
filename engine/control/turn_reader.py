"""Reads everything outside the engine thread that a turn depends on, as values that a tape records (ADR 0016).

Each value is read at its own moment: a stop, a disarm or a hold that is requested while a frame is measured counts at
that frame's decision, and the time of a decision includes the time that measuring took.
"""

import threading

from engine.capture.source import DepthSource
from engine.control.command_queue import CommandQueue, QueuedCommand
from engine.control.output_queues import OutputQueues
from engine.control.session_limits import SessionLimits
from engine.control.turn_inputs import CommandInputs, FrameInput, TurnInputs
from engine.control.watchdog import Watchdog
from engine.core.clock import NS_PER_MS, NS_PER_S, Clock
from engine.core.commands import Arm
from engine.core.errors import FrameTimeoutError, SourceAwayError
from engine.core.input_tap import NO_TAP, InputKind, InputTap
from engine.gating.gate import Gate
from engine.gating.interlocks import DecisionInputs
from engine.gating.limits import ns_from_ms
from engine.gating.supervision.operator_presence import OperatorPresence

SHORTEST_READ_NS = NS_PER_MS


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
