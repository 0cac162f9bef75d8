"""A beam line whose answers are heard: what it raises and reads back makes a session differ from another."""

from typing import Protocol

from engine.permits import HoldReason, Lease
from engine.witness import Seam, Witness


class AskedLine(Protocol):
    """What the engine's thread asks of a line; see :class:`engine.beam.line.BeamLine`."""

    def open(self) -> None:
        """Connect."""

    def rearm(self) -> None:
        """Accept permits again."""

    def permit(self, lease: Lease) -> None:
        """Let the beam be on until the lease ends."""

    def hold(self, reason: HoldReason) -> None:
        """Take the permit back now."""

    def is_on(self) -> bool:
        """Read back whether the line is on."""

    @property
    def is_settling(self) -> bool:
        """Whether the last order may still be on its way."""


class WitnessedLine:
    """The engine thread's way to its line; other threads hold the line itself.

    The line is told first, and only then is written down what it answered.
    """

    def __init__(self, line: AskedLine, witness: Witness) -> None:
        self._line, self._witness = line, witness

    def open(self) -> None:
        """Connect."""
        self._witness.heard(Seam.LINE, self._line.open)

    def rearm(self) -> None:
        """Accept permits again."""
        self._witness.heard(Seam.LINE, self._line.rearm)

    def permit(self, lease: Lease) -> None:
        """Let the beam be on until the lease ends."""
        self._witness.heard(Seam.LINE, lambda: self._line.permit(lease))

    def hold(self, reason: HoldReason) -> None:
        """Take the permit back now."""
        self._witness.heard(Seam.LINE, lambda: self._line.hold(reason))

    def is_on(self) -> bool:
        """Read back whether the line is on."""
        return self._witness.heard(Seam.LINE, self._line.is_on)

    @property
    def is_settling(self) -> bool:
        """Whether the last order may still be on its way."""
        return self._witness.heard(Seam.LINE, lambda: self._line.is_settling)
