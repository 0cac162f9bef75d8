"""Whether the person who armed is still there: their page says so, again and again.

Written by the service's threads and read by the engine's; every attribute is written in one step, so nobody waits.
"""

from engine.clock import NS_PER_S, Clock

UNNAMED = ""


class Presence:
    """When the person who armed was last heard of; ``timeout_s`` of 0 asks nobody."""

    def __init__(self, *, clock: Clock, timeout_s: float) -> None:
        self._clock = clock
        self._timeout_ns = int(timeout_s * NS_PER_S)
        self._armed_by = UNNAMED
        self._seen_ns = clock.now_ns()

    def arm(self, operator: str) -> None:
        """Watch for this person from now on: who arms is there."""
        self._seen_ns = self._clock.now_ns()
        self._armed_by = operator

    def note(self, operator: str) -> None:
        """Hear of somebody, from any thread; only the person who armed counts."""
        if operator == self._armed_by:
            self._seen_ns = self._clock.now_ns()

    def silence(self, now_ns: int) -> str:
        """Say for how long the person who armed has been silent, if that is too long; empty when it is not."""
        silent_ns = now_ns - self._seen_ns
        if self._timeout_ns <= 0 or silent_ns <= self._timeout_ns:
            return ""
        return f"nothing heard of {self._armed_by} for {silent_ns / NS_PER_S:.1f} s"
