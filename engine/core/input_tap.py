"""The one place through which the engine thread reads everything outside itself, so that a session can be replayed.

The engine thread only computes; what it reads are a few values (:mod:`engine.control.turn_inputs`), the clock, and the
results of training. Each reading passes :meth:`InputTap.observe`. One tap records the readings on a tape, one replays
them from a tape (ADR 0013, ADR 0016), and the default one does neither.
"""

import enum
from collections.abc import Callable
from typing import Protocol, TypeVar

from engine.core.clock import Clock

T = TypeVar("T")


class InputKind(enum.IntEnum):
    """The kind of a reading; its number is part of the tape's format and never changes its meaning.

    Numbers up to 17 that are missing here are those of ``tidegate.tape/1``.
    """

    CLOCK = 1
    SOURCE_OPENED = 3
    WATCHDOG_RECORDED = 12
    TRAINED = 17
    TURN = 18
    COMMAND = 19
    FRAME = 20
    DECISION = 21
    LINE = 22


class InputTap(Protocol):
    """Observes what the engine thread reads, and what it makes of it."""

    def begin(self) -> None:
        """Make the calling thread the engine thread: readings of other threads are not observed."""

    def observe(self, kind: InputKind, read: Callable[[], T]) -> T:
        """Return what ``read`` returns, or raise what it raises; a replay returns what is on the tape instead."""

    def emit(self, outcome: object) -> None:
        """Take an output of the engine: the record of a frame, or a transition."""

    def turn(self) -> None:
        """End a turn of the loop; never waits."""

    def end(self) -> None:
        """End the session."""


class _NoTap:
    """Records nothing."""

    def begin(self) -> None:
        """Do nothing: readings of every thread are passed on."""

    def observe(self, _kind: InputKind, read: Callable[[], T]) -> T:
        """Return the reading."""
        return read()

    def emit(self, _outcome: object) -> None:
        """Drop the output."""

    def turn(self) -> None:
        """Do nothing."""

    def end(self) -> None:
        """Do nothing."""


NO_TAP: InputTap = _NoTap()


class TappedClock:
    """A clock whose readings are observed."""

    def __init__(self, clock: Clock, tap: InputTap) -> None:
        self._read = clock.now_ns
        self._tap = tap

    def now_ns(self) -> int:
        """Return the time [ns]."""
        return self._tap.observe(InputKind.CLOCK, self._read)
