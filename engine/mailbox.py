"""How other threads reach the engine: commands with futures, and faults that somebody else has seen.

Bounded, and never waited for. A disarming or a hold by hand is never refused, overtakes everything, and takes back
every arming or release asked for before it, also one that comes here only afterwards; any other command that had to
wait too long is refused rather than carried out as a surprise.
"""

import threading
from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass

from engine.clock import NS_PER_MS, Clock
from engine.commands import Arm, Command, Disarm, HoldBeam, ReleaseBeam
from engine.errors import CommandRefusedError
from engine.permits import HoldReason
from engine.stages.gate import Interruption

MAX_WAIT_NS = 1_000 * NS_PER_MS

URGENT = (Disarm, HoldBeam)
"""What overtakes everything, and is carried out even if its asker has given up."""

_TAKES_BACK: dict[type, type] = {Disarm: Arm, HoldBeam: ReleaseBeam}
_TAKEN_BACK_BY: dict[type, type] = {undone: by for by, undone in _TAKES_BACK.items()}


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Letter:
    """A command on its way, and where its answer goes."""

    command: Command
    answer: Future[None]
    submitted_ns: int

    def refuse(self, sentence: str) -> None:
        """Answer with a refusal, unless nobody waits any more."""
        if self.answer.set_running_or_notify_cancel():
            self.answer.set_exception(CommandRefusedError(sentence))


class Mailbox:
    """Commands and reports for one engine; any thread may submit, the engine takes."""

    def __init__(self, *, clock: Clock, capacity: int, longest_silence_ns: int = 0) -> None:
        self._clock = clock
        self._capacity = capacity
        self._longest_silence_ns = longest_silence_ns
        self._service_heard_ns: int | None = None
        self._lock = threading.Lock()
        self._letters: deque[Letter] = deque()
        self._urgent: list[Letter] = []
        self._newest_asked_ns: dict[type, int] = {}
        self._report: Interruption | None = None
        self._closed_because: str | None = None

    def submit(
        self, command: Command, *, answer: Future[None] | None = None, submitted_ns: int | None = None
    ) -> Future[None]:
        """Queue a command; raise CommandRefusedError at once if it cannot be.

        ``answer`` and ``submitted_ns`` are those of a command that was asked for elsewhere, and has travelled.
        """
        letter = Letter(
            command=command,
            answer=Future() if answer is None else answer,
            submitted_ns=self._clock.now_ns() if submitted_ns is None else submitted_ns,
        )
        with self._lock:
            if self._closed_because is not None:
                raise CommandRefusedError(self._closed_because)
            if not isinstance(command, URGENT):
                self._refuse_overtaken(letter)
                self._put(letter)
                return letter.answer
            kind = type(command)
            self._newest_asked_ns[kind] = max(letter.submitted_ns, self._newest_asked_ns.get(kind, letter.submitted_ns))
            taken_back = self._take_back(_TAKES_BACK[type(command)])
            urgent = self._put_urgent(letter)
        sentence = "disarmed" if isinstance(command, Disarm) else "the beam was held"
        for earlier in taken_back:  # outside of the lock: an answer may call its asker back
            earlier.refuse(f"{sentence} before it was carried out")
        return urgent.answer

    @property
    def hold_asked_by(self) -> str | None:
        """Who waits for the beam to be held by hand: a decision on its way must not turn it on any more."""
        return self._asked_by(HoldBeam)

    @property
    def disarm_asked_by(self) -> str | None:
        """Who waits for the gate to be disarmed, likewise."""
        return self._asked_by(Disarm)

    def _asked_by(self, kind: type[HoldBeam | Disarm]) -> str | None:
        asked = (letter.command.operator for letter in tuple(self._urgent) if isinstance(letter.command, kind))
        return next(asked, None)

    def report(self, fault: Interruption) -> None:
        """Leave a fault for the next decision; the first one stays."""
        if not fault.reason.is_fault:
            msg = f"{fault.reason} is no fault"
            raise ValueError(msg)
        with self._lock:
            self._report = self._report or fault

    def take_report(self, *, is_armed: bool = False) -> Interruption | None:
        """Take the fault that was left, if any; an armed gate's service that is silent is one for as long as it is."""
        with self._lock:
            report, self._report = self._report, None
        return report or (self._service_silence() if is_armed else None)

    def note_service(self, alive_ns: int) -> None:
        """Hear that the process which people reach the engine by was alive then; from the first time on it has to be.

        Asked by the engine's own thread, at each decision: no other thread has to be alive for a silence to be found.
        """
        self._service_heard_ns = max(alive_ns, self._service_heard_ns or 0)

    def _service_silence(self) -> Interruption | None:
        heard_ns = self._service_heard_ns
        if heard_ns is None:
            return None
        silent_ns = self._clock.now_ns() - heard_ns
        if silent_ns <= self._longest_silence_ns:
            return None
        return Interruption(
            HoldReason.SERVICE_SILENT, f"nothing heard of the service for {silent_ns / NS_PER_MS:.0f} ms"
        )

    def take(self) -> list[Letter]:
        """Take all commands that wait, the urgent ones first; refuse those that are too old."""
        with self._lock:
            taken, self._urgent = self._urgent, []
            letters = list(self._letters)
            self._letters.clear()
        now_ns = self._clock.now_ns()
        for letter in letters:
            if now_ns - letter.submitted_ns > MAX_WAIT_NS:
                letter.refuse("the engine was busy for too long: look, and ask again")
            else:
                taken.append(letter)
        return taken

    def close(self, sentence: str) -> None:
        """Refuse everything from now on, and what still waits; what was urgent has then come true by itself."""
        with self._lock:
            self._closed_because = sentence
            letters, urgent = list(self._letters), self._urgent
            self._letters.clear()
            self._urgent = []
        for letter in letters:
            letter.refuse(sentence)
        for letter in urgent:
            if letter.answer.set_running_or_notify_cancel():
                letter.answer.set_result(None)

    def _refuse_overtaken(self, letter: Letter) -> None:
        """Refuse what was asked for before that which undoes it, however late it comes."""
        by = _TAKEN_BACK_BY.get(type(letter.command))
        undone_ns = None if by is None else self._newest_asked_ns.get(by)
        if undone_ns is not None and letter.submitted_ns < undone_ns:
            what = "disarmed" if by is Disarm else "the beam was held"
            msg = f"{what} after this was asked for: look, and ask again"
            raise CommandRefusedError(msg)

    def _put(self, letter: Letter) -> None:
        if len(self._letters) >= self._capacity:
            msg = f"{self._capacity} commands wait already: try again in a moment"
            raise CommandRefusedError(msg)
        self._letters.append(letter)

    def _put_urgent(self, letter: Letter) -> Letter:
        """Queue it last; one of its kind that waits already does for both, in the newer one's place."""
        kind = type(letter.command)
        waiting = next((earlier for earlier in self._urgent if type(earlier.command) is kind), letter)
        self._urgent = [other for other in self._urgent if other is not waiting] + [waiting]
        return waiting

    def _take_back(self, kind: type) -> list[Letter]:
        taken = [letter for letter in self._letters if isinstance(letter.command, kind)]
        for letter in taken:
            self._letters.remove(letter)
        return taken
