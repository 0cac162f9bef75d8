"""The role of a beam line: it transmits the permit to the accelerator."""

from collections.abc import Callable
from typing import Protocol, TypeAlias

from engine.core.gate_state import HoldReason, Lease

TroubleListener: TypeAlias = Callable[[HoldReason, str], None]


class BeamLine(Protocol):
    """A way to the accelerator's gating input; owned by the engine, held by the watchdog too.

    ``permit`` is a lease that lapses by itself in the line: a lease that is not renewed ends in off, and permits are
    refused (`LeaseLapsedError`) until the line was held, so that a dwell comes between. ``hold`` must be callable from
    any thread, at any time, twice, before ``open`` and after ``close``, and must neither block nor raise.

    A hold wins every race with a permit: a lease granted before the newest hold is refused. A hold for a fault (see
    :attr:`HoldReason.is_fault`) latches: every permit is refused until ``rearm``, which only a person's arming calls.

    A wired line takes time. Until its last command is read back it is settling: after a permit it counts as not yet on,
    after a hold as still on. It supervises that time itself: when it is exceeded, the line holds, latches and raises.

    Attributes
    ----------
    on_trouble
        Called once for each fault that the line itself detects, after the hold, in a thread of the line.
    """

    on_trouble: TroubleListener

    def open(self) -> None:
        """Connect; the line is off. Raise BeamLineError if it does not answer."""

    def rearm(self) -> None:
        """Accept permits again after a latched hold; the line stays off. Raise BeamLineError if it does not answer."""

    def permit(self, lease: Lease) -> None:
        """Let the beam be on until the lease ends; raise BeamLineError if that was not accepted."""

    def hold(self, reason: HoldReason) -> None:
        """Withdraw the permit now."""

    def is_on(self) -> bool:
        """Read back whether the line is on.

        Raises
        ------
        BeamLineMismatchError
            The read-back differs from the command.
        BeamLineError
            It does not answer.
        """

    @property
    def is_settling(self) -> bool:
        """Whether the last command is not read back yet; never for a line that acts at once."""

    def close(self) -> None:
        """Hold, then disconnect; safe to call twice."""


def ignore_trouble(_reason: HoldReason, _detail: str) -> None:
    """Do nothing: the listener of a line until another one is set."""
