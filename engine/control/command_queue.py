"""Commands and faults of other threads for the engine thread.

Bounded; no thread waits for it. A disarm or a hold by hand is never refused, overtakes everything, and cancels every
arming or release that was submitted before it, even one that arrives later. Any other command that waited too long is
refused, because its caller no longer waits for it.

Every command that the engine carries out.
"""

import threading
from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass

from engine.core.clock import NS_PER_MS, Clock
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
from engine.core.errors import CommandRefusedError
from engine.core.gate_state import HoldReason
from engine.core.sentences import say
from engine.gating.active_window import SetWindow
from engine.gating.gate import Interruption

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
