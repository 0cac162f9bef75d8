"""Presence of the operator who armed, by the messages that their page repeats.

The service's threads write, the engine thread reads; every attribute is written in one step, so no thread waits.
"""

from engine.core.clock import NS_PER_S, Clock

UNNAMED = ""


class OperatorPresence:
    """Time of the last message from the operator who armed; a ``timeout_s`` of 0 switches the check off."""

    def __init__(self, *, clock: Clock, timeout_s: float) -> None:
        self._clock = clock
        self._timeout_ns = int(timeout_s * NS_PER_S)
        self._armed_by = UNNAMED
        self._seen_ns = clock.now_ns()

    def arm(self, operator: str) -> None:
        """Supervise this operator from now on; arming counts as a message."""
        self._seen_ns = self._clock.now_ns()
        self._armed_by = operator

    def note(self, operator: str) -> None:
        """Note a message of an operator, from any thread; only the one who armed counts."""
        if operator == self._armed_by:
            self._seen_ns = self._clock.now_ns()

    def silence(self, now_ns: int) -> str:
        """Return the text of a silence beyond the timeout; empty otherwise."""
        silent_ns = now_ns - self._seen_ns
        if self._timeout_ns <= 0 or silent_ns <= self._timeout_ns:
            return ""
        return f"no message from {self._armed_by} for {silent_ns / NS_PER_S:.1f} s"
