"""The role of everything that carries the permit to the accelerator."""

from typing import Protocol

from engine.permits import HoldReason, Lease


class BeamLine(Protocol):
    """A way to the accelerator's gating input; owned by the engine, held by the watchdog too.

    ``permit`` is a lease that lapses by itself in the line: when nobody renews it the line goes off. ``hold`` must be
    callable from any thread, at any time, twice, before ``open`` and after ``close``, and must neither block nor raise.

    A hold wins every race with a permit: a lease granted before the newest hold is refused. A hold for a fault (see
    :attr:`HoldReason.is_fault`) latches: every permit is refused until ``rearm``, which only a person's arming calls.
    """

    def open(self) -> None:
        """Connect; the line is off. Raise BeamLineError if it does not answer."""

    def rearm(self) -> None:
        """Accept permits again after a latched hold; the line stays off. Raise BeamLineError if it does not answer."""

    def permit(self, lease: Lease) -> None:
        """Let the beam be on until the lease ends; raise BeamLineError if that was not accepted."""

    def hold(self, reason: HoldReason) -> None:
        """Take the permit back now."""

    def is_on(self) -> bool:
        """Read back whether the line is on; raise BeamLineError if it does not answer."""

    def close(self) -> None:
        """Hold, then disconnect; safe to call twice."""
