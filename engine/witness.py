"""What the engine hears from outside of itself, each in one place and in one order: so that it can be heard again.

The engine's thread computes; all else it hears: what time it is, which frame came, what people asked for, what the line
reads back, whether a queue is full. Every such answer passes :meth:`Witness.heard`. A witness that writes the answers
down and one that gives them again make of a session's tape the same session (ADR 0013); the usual one only passes them
on.
"""

import enum
from collections.abc import Callable
from typing import Protocol, TypeVar

from engine.clock import Clock

T = TypeVar("T")


class Seam(enum.IntEnum):
    """Where an answer comes from; the numbers stand in tapes, so none is ever used again for something else."""

    CLOCK = 1
    STOP_ASKED = 2
    SOURCE_OPENED = 3
    FRAME = 4
    LETTERS = 5
    IS_WANTED = 6
    REPORT = 7
    DISARM_ASKED = 8
    HOLD_ASKED = 9
    WATCHDOG_FIRED = 10
    WATCHDOG_WATCHES = 11
    WATCHDOG_TOLD = 12
    QUEUES = 13
    DELAY = 14
    ABSENCE = 15
    LINE = 16
    TRAINED = 17


class Witness(Protocol):
    """Stands between the engine's thread and everything it hears."""

    def begin(self) -> None:
        """Take the calling thread for the engine's: what others ask is not of the session's making."""

    def heard(self, seam: Seam, ask: Callable[[], T]) -> T:
        """Return what ``ask`` answers, or raise what it raises."""

    def told(self, outcome: object) -> None:
        """Hear what came of it: a record of a frame, or a transition."""

    def turn(self) -> None:
        """Hear that all of one frame is done, and another begins; never waits."""

    def end(self) -> None:
        """Hear that nothing comes any more."""


class _Nobody:
    """Passes every answer on."""

    def begin(self) -> None:
        """Care for no thread."""

    def heard(self, _seam: Seam, ask: Callable[[], T]) -> T:
        """Ask."""
        return ask()

    def told(self, _outcome: object) -> None:
        """Forget it."""

    def turn(self) -> None:
        """Go on."""

    def end(self) -> None:
        """Leave."""


NOBODY: Witness = _Nobody()


class WitnessedClock:
    """A clock whose readings are heard."""

    def __init__(self, clock: Clock, witness: Witness) -> None:
        self._read = clock.now_ns
        self._witness = witness

    def now_ns(self) -> int:
        """Return the time [ns]."""
        return self._witness.heard(Seam.CLOCK, self._read)
