"""A beam line whose answers are observed by the input tap: what it reads back and raises is part of a session."""

from typing import Protocol

from engine.core.gate_state import HoldReason, Lease
from engine.core.input_tap import InputKind, InputTap


class AskedLine(Protocol):
    """The part of :class:`engine.beam.line.BeamLine` that the engine thread uses."""

    def open(self) -> None:
        """Connect."""

    def rearm(self) -> None:
        """Accept permits again."""

    def permit(self, lease: Lease) -> None:
        """Let the beam be on until the lease ends."""

    def hold(self, reason: HoldReason) -> None:
        """Withdraw the permit now."""

    def is_on(self) -> bool:
        """Read back whether the line is on."""

    @property
    def is_settling(self) -> bool:
        """Whether the last command is not read back yet."""


class TappedLine:
    """The beam line of the engine thread; other threads use the line itself.

    The line is ordered first, and its answer is recorded after that.
    """

    def __init__(self, line: AskedLine, tap: InputTap) -> None:
        self._line, self._tap = line, tap

    def open(self) -> None:
        """Connect."""
        self._tap.observe(InputKind.LINE, self._line.open)

    def rearm(self) -> None:
        """Accept permits again."""
        self._tap.observe(InputKind.LINE, self._line.rearm)

    def permit(self, lease: Lease) -> None:
        """Let the beam be on until the lease ends."""
        self._tap.observe(InputKind.LINE, lambda: self._line.permit(lease))

    def hold(self, reason: HoldReason) -> None:
        """Withdraw the permit now."""
        self._tap.observe(InputKind.LINE, lambda: self._line.hold(reason))

    def is_on(self) -> bool:
        """Read back whether the line is on."""
        return self._tap.observe(InputKind.LINE, self._line.is_on)

    @property
    def is_settling(self) -> bool:
        """Whether the last command is not read back yet."""
        return self._tap.observe(InputKind.LINE, lambda: self._line.is_settling)
