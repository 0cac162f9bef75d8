"""Holds the beam when the engine thread stops deciding, wherever it hangs.

The engine thread feeds it after every decision. Where the newest decision was an armed gate's and is older than the
deadline, the watchdog holds the line from its own thread, latches, and calls ``on_fired``. Only the acknowledgement of
a named person resets it. It cannot permit a beam.
"""

import threading
from typing import TYPE_CHECKING

from engine.beam.line import BeamLine
from engine.core.clock import NS_PER_S, Clock
from engine.core.gate_state import HoldReason

if TYPE_CHECKING:
    from collections.abc import Callable

CHECKS_PER_DEADLINE = 10


class Watchdog:
    """A deadline, and the thread that watches it.

    Parameters
    ----------
    deadline_ns
        Longest time between two decisions of an armed gate.

    Attributes
    ----------
    on_fired
        Called once each time it fires, in the watchdog's thread and after the line was held, with the time.
    """

    def __init__(
        self,
        *,
        beam: BeamLine,
        clock: Clock,
        deadline_ns: int,
    ) -> None:
        self._beam = beam
        self._clock = clock
        self._deadline_ns = deadline_ns
        self.on_fired: Callable[[int], None] = lambda _at_ns: None
        self._armed_since_ns: int | None = None
        self._has_fired = False
        self._stop_requested = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="tidegate-watchdog", daemon=True)

    @property
    def has_fired(self) -> bool:
        """Whether it has held the beam, without an acknowledgement since."""
        return self._has_fired

    @property
    def is_watching(self) -> bool:
        """Whether its thread is alive."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Start watching."""
        self._thread.start()

    def stop(self, timeout_s: float = 1.0) -> None:
        """Stop watching; the line must be held by then."""
        self._stop_requested.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def feed(self, decided_ns: int, *, is_armed: bool) -> None:
        """Note a decision at ``decided_ns`` [ns, host monotonic]; a disarmed gate is not watched."""
        self._armed_since_ns = decided_ns if is_armed else None

    def reset(self) -> None:
        """Clear the latch after an acknowledgement. The line stays latched until the gate is armed again."""
        self._armed_since_ns = None
        self._has_fired = False

    def check(self, now_ns: int) -> bool:
        """Hold the beam if the deadline has passed; return whether it has fired, now or before."""
        armed_since_ns = self._armed_since_ns
        if self._has_fired or armed_since_ns is None or now_ns - armed_since_ns <= self._deadline_ns:
            return self._has_fired
        self._has_fired = True  # before the hold: an engine that arms meanwhile must see one or the other
        self._beam.hold(HoldReason.WATCHDOG)
        self.on_fired(now_ns)
        return True

    def _watch(self) -> None:
        period_s = self._deadline_ns / CHECKS_PER_DEADLINE / NS_PER_S
        while not self._stop_requested.wait(period_s):
            self.check(self._clock.now_ns())
