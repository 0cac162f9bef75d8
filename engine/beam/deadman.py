"""The dead-man rule of every line, without hardware: on is a function of the lease, the newest hold and the clock.

Two clocks may be involved. ``decided_ns`` and ``at_ns`` are the sender's and are only compared with each other: they
order permits and holds, however late these arrive. ``expires_ns`` and ``now_ns`` are the line's own.

No lock: each attribute is written in one step and read once, and whether the line is on is computed from all of them.
So a hold never waits for another thread, and a permit that races with it cannot undo it.

A permit that lapsed was not renewed in time, and the line went off without a decision: it stays off until it is held.
So the next permit comes from a gate that has noticed, after a dwell.
"""

from dataclasses import dataclass

from engine.core.clock import NS_PER_MS
from engine.core.errors import BeamLineError, LeaseLapsedError

MAX_LEASE_NS = 250 * NS_PER_MS
"""Longest lease that is accepted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Grant:
    """A permit as stored in the line."""

    decided_ns: int
    expires_ns: int
    sequence: int


class DeadMan:
    """Stores the newest permit and the newest hold; off at the start, and latched until :meth:`rearm`."""

    def __init__(self) -> None:
        self._grant: Grant | None = None
        self._held_at_ns: int | None = None
        self._last_sequence = -1
        self._is_latched = True
        self._has_lapsed = False

    def rearm(self) -> None:
        """Accept permits again, with a new sequence; the line stays off because earlier permits are deleted first."""
        self._grant = None
        self._last_sequence = -1
        self._is_latched = self._has_lapsed = False

    def grant(self, grant: Grant, *, now_ns: int) -> None:
        """Store a permit.

        Raises
        ------
        BeamLineError
            The permit is refused: latched, older than a hold or a permit, lapsed, or too long.
        LeaseLapsedError
            The permit before has lapsed, and no hold has followed.
        """
        refusal = self._refusal(grant, now_ns)
        if refusal is not None:
            raise BeamLineError(refusal)
        before = self._grant
        if self._has_lapsed or (before is not None and now_ns >= before.expires_ns):
            msg = f"the permit before permit {grant.sequence} had lapsed in the line"
            raise LeaseLapsedError(msg)
        self._last_sequence = grant.sequence
        self._grant = grant

    def hold(self, *, at_ns: int, is_latching: bool) -> None:
        """Withdraw the permit; with ``is_latching`` refuse permits until :meth:`rearm`."""
        if is_latching:
            self._is_latched = True
        self._held_at_ns = at_ns
        self._grant = None
        self._has_lapsed = False

    def is_on(self, now_ns: int) -> bool:
        """Whether the line is on at ``now_ns``; a lapse that is seen here cannot be undone by a permit under way."""
        grant = self._grant
        if grant is not None and now_ns >= grant.expires_ns:
            self._has_lapsed = True
        return grant is not None and not self._has_lapsed and not self._is_latched and self._is_newer(grant)

    @property
    def held_at_ns(self) -> int | None:
        """Time of the last hold, by the sender's clock [ns]; None if there was none."""
        return self._held_at_ns

    @property
    def expires_ns(self) -> int | None:
        """When the present permit lapses by itself [ns]; None without one."""
        grant = self._grant
        return None if grant is None else grant.expires_ns

    def _is_newer(self, grant: Grant) -> bool:
        held_at_ns = self._held_at_ns
        return held_at_ns is None or grant.decided_ns > held_at_ns

    def _refusal(self, grant: Grant, now_ns: int) -> str | None:
        if self._is_latched:
            return "the line is latched off until it is armed again"
        if grant.sequence <= self._last_sequence:
            return f"permit {grant.sequence} came after permit {self._last_sequence}"
        if not self._is_newer(grant):
            return f"permit {grant.sequence} was decided before the newest hold"
        if now_ns >= grant.expires_ns:
            return f"permit {grant.sequence} has lapsed already"
        if grant.expires_ns - now_ns > MAX_LEASE_NS:
            return f"permit {grant.sequence} is for more than {MAX_LEASE_NS // NS_PER_MS} ms"
        return None
