"""A beam line in memory, for simulation and tests: the dead-man rule and a log of edges."""

from collections import deque
from dataclasses import dataclass

from engine.beam.deadman import DeadMan, Grant
from engine.beam.line import TroubleListener, ignore_trouble
from engine.core.clock import Clock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease

HISTORY = 4096


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamEdge:
    """The line went on or off; ``reason`` is None when it went on, or off because its lease lapsed."""

    at_ns: int
    is_on: bool
    reason: HoldReason | None = None


class SimulatedBeamLine:
    """`BeamLine` with a record of its edges; leases lapse by ``clock``."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._deadman = DeadMan()
        self.on_trouble: TroubleListener = ignore_trouble
        self._is_open = False
        self._events: deque[tuple[int, Lease | HoldReason]] = deque(maxlen=HISTORY)

    def open(self) -> None:
        """Connect; the line is off."""
        self._is_open = True

    def rearm(self) -> None:
        """Accept permits again after a latched hold; the line stays off."""
        self._deadman.rearm()

    def permit(self, lease: Lease) -> None:
        """Be on until the lease ends; raise BeamLineError if it is refused."""
        if not self._is_open:
            msg = "the line is closed"
            raise BeamLineError(msg)
        now_ns = self._clock.now_ns()
        grant = Grant(decided_ns=lease.granted_ns, expires_ns=lease.expires_ns, sequence=lease.sequence)
        self._deadman.grant(grant, now_ns=now_ns)
        self._events.append((now_ns, lease))

    def hold(self, reason: HoldReason) -> None:
        """Be off now; any thread, any time."""
        now_ns = self._clock.now_ns()
        self._deadman.hold(at_ns=now_ns, is_latching=reason.is_fault)
        self._events.append((now_ns, reason))

    def is_on(self) -> bool:
        """Whether the line is on."""
        return self._is_open and self._deadman.is_on(self._clock.now_ns())

    @property
    def is_settling(self) -> bool:
        """Never: the line switches at once."""
        return False

    def close(self) -> None:
        """Hold, then disconnect."""
        self.hold(HoldReason.ENGINE_STOPPED)
        self._is_open = False

    @property
    def edges(self) -> tuple[BeamEdge, ...]:
        """Edges, oldest first, as far as the bounded history reaches back."""
        return _edges(list(self._events), self._clock.now_ns())


def _edges(happened: list[tuple[int, Lease | HoldReason]], now_ns: int) -> tuple[BeamEdge, ...]:
    """Replay permits and holds into edges, lapses included."""
    edges: list[BeamEdge] = []
    expires_ns: int | None = None
    held_at_ns = -1
    for at_ns, event in happened:
        if expires_ns is not None and at_ns >= expires_ns:
            edges.append(BeamEdge(at_ns=expires_ns, is_on=False))
            expires_ns = None
        if isinstance(event, Lease):
            if event.granted_ns <= held_at_ns:
                continue  # accepted in the same instant as another thread's hold, which has won
            if expires_ns is None:
                edges.append(BeamEdge(at_ns=at_ns, is_on=True))
            expires_ns = event.expires_ns
            continue
        held_at_ns = at_ns
        if expires_ns is not None:
            edges.append(BeamEdge(at_ns=at_ns, is_on=False, reason=event))
            expires_ns = None
    if expires_ns is not None and now_ns >= expires_ns:
        edges.append(BeamEdge(at_ns=expires_ns, is_on=False))
    return tuple(edges)
