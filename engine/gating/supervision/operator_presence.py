"""Presence of a person at the page, by the messages that it repeats (ADR 0024).

An armed gate needs a person who sees the page and can hold: the person who armed it or released a hold since; where a
program armed it, any person who may arm. The service's threads write, and only for such persons; the engine thread
reads. Every attribute is written in one step, so no thread waits.
"""

from engine.core.clock import NS_PER_S, Clock
from engine.core.sentences import say
from engine.gating.gate import Gate

MOST_PERSONS = 256
"""More persons than any site has at its pages; beyond that all are forgotten, which holds the beam."""
NO_PERSON = say("no person who may arm is at the page")


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
