"""What the engine thread reads in one turn, as values that a tape records (ADR 0016), and the queue of commands.

A turn reads one :class:`TurnInputs`, one :class:`CommandInputs` for each command, at most one :class:`FrameInput`, and
for each decision one :class:`engine.gating.interlocks.DecisionInputs` and a :class:`LineAnswer` for each order to the
line. Each is read at its own moment: a stop, a disarm or a hold that is requested while a frame is measured counts at
that frame's decision, and the time of a decision includes the time that measuring took. Tapes omit defaults, so they
must never change.
"""

import threading
from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass

from engine.capture.source import DepthSource
from engine.control.output_queues import OutputQueues
from engine.control.session_state import SessionLimits
from engine.control.watchdog import Watchdog
from engine.core.clock import NS_PER_MS, NS_PER_S, Clock
from engine.core.commands import (
    Acknowledge,
    ActivateModel,
    ApplyModel,
    Arm,
    CorrectBaseline,
    Countersign,
    Disarm,
    HoldBeam,
    ReleaseBeam,
    Retrain,
    SetReference,
    SignPosition,
)
from engine.core.errors import CommandRefusedError, FrameTimeoutError, SourceAwayError
from engine.core.frames import RgbdFrame
from engine.core.gate_state import HoldReason
from engine.core.input_tap import NO_TAP, InputKind, InputTap
from engine.core.sentences import say
from engine.gating.active_window import SetWindow
from engine.gating.gate import Gate, Interruption
from engine.gating.interlocks import DecisionInputs, OperatorPresence
from engine.gating.limits import ns_from_ms

Command = (
    Arm
    | Disarm
    | Acknowledge
    | SetReference
    | SignPosition
    | Countersign
    | Retrain
    | ApplyModel
    | ActivateModel
    | HoldBeam
    | ReleaseBeam
    | CorrectBaseline
    | SetWindow
)

MAX_WAIT_NS = 1_000 * NS_PER_MS

URGENT = (Disarm, HoldBeam)
"""Commands that overtake everything, and are carried out even if their caller has given up."""

MOST_PERSONS = 16
"""How many persons' holds, or disarms, wait one by one; a further one joins the oldest."""

_CANCELS: dict[type, type] = {Disarm: Arm, HoldBeam: ReleaseBeam}

_CANCELLED_BY: dict[type, type] = {cancelled: by for by, cancelled in _CANCELS.items()}

SHORTEST_READ_NS = NS_PER_MS


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class QueuedCommand:
    """A submitted command, and the future for its answer."""

    command: Command
    answer: Future[None]
    submitted_ns: int

    def refuse(self, sentence: str) -> None:
        """Answer with a refusal, unless the caller has given up."""
        if self.answer.set_running_or_notify_cancel():
            self.answer.set_exception(CommandRefusedError(sentence))


class CommandQueue:
    """Commands and reported faults for one engine: any thread submits, the engine thread takes."""

    def __init__(self, *, clock: Clock, capacity: int, longest_silence_ns: int = 0) -> None:
        self._clock = clock
        self._capacity = capacity
        self._longest_silence_ns = longest_silence_ns
        self._service_alive_ns: int | None = None
        self._lock = threading.Lock()
        self._waiting: deque[QueuedCommand] = deque()
        self._urgent: list[QueuedCommand] = []
        self._newest_submitted_ns: dict[type, int] = {}
        self._report: Interruption | None = None
        self._closed_because: str | None = None

    def submit(
        self, command: Command, *, answer: Future[None] | None = None, submitted_ns: int | None = None
    ) -> Future[None]:
        """Queue a command; raise CommandRefusedError at once if it cannot be.

        ``answer`` and ``submitted_ns`` are those of a command that was submitted in another process.
        """
        queued = QueuedCommand(
            command=command,
            answer=Future() if answer is None else answer,
            submitted_ns=self._clock.now_ns() if submitted_ns is None else submitted_ns,
        )
        with self._lock:
            if self._closed_because is not None:
                raise CommandRefusedError(self._closed_because)
            if not isinstance(command, URGENT):
                self._refuse_cancelled(queued)
                self._put(queued)
                return queued.answer
            kind = type(command)
            self._newest_submitted_ns[kind] = max(
                queued.submitted_ns, self._newest_submitted_ns.get(kind, queued.submitted_ns)
            )
            cancelled = self._cancel(_CANCELS[type(command)])
            urgent = self._put_urgent(queued)
        sentence = say("disarmed") if isinstance(command, Disarm) else say("the beam was held")
        for earlier in cancelled:  # outside the lock: an answer may call back into the caller
            earlier.refuse(say("{sentence} before it was carried out", sentence=sentence))
        return urgent.answer

    @property
    def hold_requested_by(self) -> str | None:
        """The operator whose hold waits here: a decision that is being made must not permit the beam any more."""
        return self._submitter_of(HoldBeam)

    @property
    def disarm_requested_by(self) -> str | None:
        """The operator whose disarm waits here, likewise."""
        return self._submitter_of(Disarm)

    def _submitter_of(self, kind: type[HoldBeam | Disarm]) -> str | None:
        submitters = (queued.command.operator for queued in tuple(self._urgent) if isinstance(queued.command, kind))
        return next(submitters, None)

    def report(self, fault: Interruption) -> None:
        """Report a fault to the next decision; of several, the first one counts."""
        if not fault.reason.is_fault:
            msg = say("{reason} is no fault", reason=fault.reason)
            raise ValueError(msg)
        with self._lock:
            self._report = self._report or fault

    def take_report(self, *, is_armed: bool = False) -> Interruption | None:
        """Return the reported fault, if any; while the gate is armed, the silence of the service is one too."""
        with self._lock:
            report, self._report = self._report, None
        return report or (self._service_silence() if is_armed else None)

    def note_service(self, alive_ns: int) -> None:
        """Note that the service served at ``alive_ns``; from the first time on its silence is a fault.

        The engine thread checks it at each decision, so that no other thread has to be alive to detect it.
        """
        self._service_alive_ns = max(alive_ns, self._service_alive_ns or 0)

    def _service_silence(self) -> Interruption | None:
        alive_since_ns = self._service_alive_ns
        if alive_since_ns is None:
            return None
        silent_ns = self._clock.now_ns() - alive_since_ns
        if silent_ns <= self._longest_silence_ns:
            return None
        return Interruption(
            HoldReason.SERVICE_SILENT,
            say("nothing heard of the service for {silent_ms:.0f} ms", silent_ms=silent_ns / NS_PER_MS),
        )

    def take(self) -> list[QueuedCommand]:
        """Take all waiting commands, the urgent ones first; refuse those that are too old."""
        with self._lock:
            taken, self._urgent = self._urgent, []
            commands = list(self._waiting)
            self._waiting.clear()
        now_ns = self._clock.now_ns()
        for queued in commands:
            if now_ns - queued.submitted_ns > MAX_WAIT_NS:
                queued.refuse(say("the engine was busy for too long: read the session, then retry"))
            else:
                taken.append(queued)
        return taken

    def close(self, sentence: str) -> None:
        """Refuse all commands from now on, and those that wait; urgent ones are answered as done: the beam is held."""
        with self._lock:
            self._closed_because = sentence
            commands, urgent = list(self._waiting), self._urgent
            self._waiting.clear()
            self._urgent = []
        for queued in commands:
            queued.refuse(sentence)
        for queued in urgent:
            if queued.answer.set_running_or_notify_cancel():
                queued.answer.set_result(None)

    def _refuse_cancelled(self, queued: QueuedCommand) -> None:
        """Refuse a command that was submitted before the one that cancels it, however late it arrives."""
        by = _CANCELLED_BY.get(type(queued.command))
        cancelled_ns = None if by is None else self._newest_submitted_ns.get(by)
        if cancelled_ns is not None and queued.submitted_ns < cancelled_ns:
            what = say("disarmed") if by is Disarm else say("the beam was held")
            msg = say("{what} after this command was sent: read the session, then retry", what=what)
            raise CommandRefusedError(msg)

    def _put(self, queued: QueuedCommand) -> None:
        if len(self._waiting) >= self._capacity:
            msg = say("{capacity} commands wait already: try again in a moment", capacity=self._capacity)
            raise CommandRefusedError(msg)
        self._waiting.append(queued)

    def _put_urgent(self, queued: QueuedCommand) -> QueuedCommand:
        """Queue it last; the same person's of its kind that waits already answers both, in the newer one's place."""
        command = queued.command
        same = [earlier for earlier in self._urgent if type(earlier.command) is type(command)]
        own = [earlier for earlier in same if earlier.command.operator == command.operator]
        waiting = (own or (same if len(same) >= MOST_PERSONS else [queued]))[0]
        self._urgent = [other for other in self._urgent if other is not waiting] + [waiting]
        return waiting

    def _cancel(self, kind: type) -> list[QueuedCommand]:
        taken = [queued for queued in self._waiting if isinstance(queued.command, kind)]
        for queued in taken:
            self._waiting.remove(queued)
        return taken


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
