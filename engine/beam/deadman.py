"""The rule every line obeys, without any hardware: on is a function of the lease, the newest hold and the clock.

Two clocks may be at work. ``decided_ns`` and ``at_ns`` are the teller's, and are only compared with each other: they
order permits and holds however late they arrive. ``expires_ns`` and ``now_ns`` are the line's own.

No lock: each attribute is written in one step and read once, and whether the line is on is computed from all of them,
so a hold never waits for anybody and whoever comes second cannot undo it.
"""

from dataclasses import dataclass

from engine.clock import NS_PER_MS
from engine.errors import BeamLineError

MAX_LEASE_NS = 250 * NS_PER_MS
"""A longer lease is refused, whoever grants it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Grant:
    """A permit as the line keeps it."""

    decided_ns: int
    expires_ns: int
    sequence: int


class DeadMan:
    """Keeps the newest permit and the newest hold; off from the start, and latched until :meth:`rearm`."""

    def __init__(self) -> None:
        self._grant: Grant | None = None
        self._held_at_ns: int | None = None
        self._last_sequence = -1
        self._is_latched = True

    def rearm(self) -> None:
        """Accept permits again, counted anew; the line stays off, for what was granted before is forgotten first."""
        self._grant = None
        self._last_sequence = -1
        self._is_latched = False

    def grant(self, grant: Grant, *, now_ns: int) -> None:
        """Take a permit.

        Raises
        ------
        BeamLineError
            It is refused: latched, older than a hold or a permit, lapsed already, or too long.
        """
        refusal = self._refusal(grant, now_ns)
        if refusal is not None:
            raise BeamLineError(refusal)
        self._last_sequence = grant.sequence
        self._grant = grant

    def hold(self, *, at_ns: int, is_latching: bool) -> None:
        """Take the permit back; with ``is_latching`` refuse all to come."""
        if is_latching:
            self._is_latched = True
        self._held_at_ns = at_ns
        self._grant = None

    def is_on(self, now_ns: int) -> bool:
        """Whether the line is on at ``now_ns``."""
        grant = self._grant
        return grant is not None and not self._is_latched and self._is_newer(grant) and now_ns < grant.expires_ns

    @property
    def held_at_ns(self) -> int | None:
        """When it was last held, by the teller's clock; None if never."""
        return self._held_at_ns

    @property
    def expires_ns(self) -> int | None:
        """When the present permit lapses by itself; None without one."""
        grant = self._grant
        return None if grant is None else grant.expires_ns

    def _is_newer(self, grant: Grant) -> bool:
        held_at_ns = self._held_at_ns
        return held_at_ns is None or grant.decided_ns > held_at_ns

    def _refusal(self, grant: Grant, now_ns: int) -> str | None:
        if self._is_latched:
            return "the line is latched off until somebody arms again"
        if grant.sequence <= self._last_sequence:
            return f"permit {grant.sequence} came after permit {self._last_sequence}"
        if not self._is_newer(grant):
            return f"permit {grant.sequence} was decided before the newest hold"
        if now_ns >= grant.expires_ns:
            return f"permit {grant.sequence} has lapsed already"
        if grant.expires_ns - now_ns > MAX_LEASE_NS:
            return f"permit {grant.sequence} is for more than {MAX_LEASE_NS // NS_PER_MS} ms"
        return None
