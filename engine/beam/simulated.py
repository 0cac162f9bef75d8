"""A beam line in memory, for simulation and tests: the dead-man rule and a log of edges."""

from collections import deque
from dataclasses import dataclass

from engine.beam.deadman import DeadMan, Grant
from engine.beam.heartbeat_drill import LEAST_REPEATS, RECEIVER_DROP_MS
from engine.beam.line import TroubleListener, ignore_trouble
from engine.core.bounds import check_number
from engine.core.clock import NS_PER_MS, Clock
from engine.core.errors import BeamLineError
from engine.core.gate_state import HoldReason, Lease

HISTORY = 4096
ACCELERATOR_BOUNDS_MS = (0.0, 2000.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class BeamEdge:
    """The line went on or off; ``reason`` is None when it went on, or off because its lease lapsed."""

    at_ns: int
    is_on: bool
    reason: HoldReason | None = None


class SimulatedBeamLine:
    """`BeamLine` with a record of its edges; leases lapse by ``clock``.

    A killed process leaves nothing of it. For the drill of the heartbeat it stands still as a wired line does, in front
    of a `SimulatedReceiver`; its own edges do not show that.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._deadman = DeadMan()
        self.on_trouble: TroubleListener = ignore_trouble
        self._is_open = False
        self._events: deque[tuple[int, Lease | HoldReason]] = deque(maxlen=HISTORY)
        self._still_since_ns: int | None = None
        self._repeats_permit = False

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
        self._still_since_ns = None
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

    def stand_still(self) -> None:
        """Leave the permit and the heartbeat as they are until the next hold."""
        self._repeats_permit = False
        self._still_since_ns = self._clock.now_ns() if self.is_on() else None

    @property
    def still_since_ns(self) -> int | None:
        """Since when the line stands still with the permit on [ns]; None where it does not."""
        return self._still_since_ns

    def repeat_permit(self) -> None:
        """Send heartbeats again with the permit of before; ignored unless the line stands still."""
        self._repeats_permit = True

    @property
    def repeats(self) -> int:
        """How often the permit of before was sent again: as often as asked for, once it is."""
        return LEAST_REPEATS if self._repeats_permit else 0

    @property
    def sent(self) -> tuple[bool, int | None]:
        """The permit that a receiver has, and when its last heartbeat came [ns]; None while they come."""
        if self._still_since_ns is None:
            return self.is_on(), None
        return True, None if self._repeats_permit else self._still_since_ns

    @property
    def edges(self) -> tuple[BeamEdge, ...]:
        """Edges, oldest first, as far as the bounded history reaches back."""
        return _edges(list(self._events), self._clock.now_ns())


class SimulatedReceiver:
    """The receiver behind a simulated line, and the second input that sees its contact (`SecondInput`).

    It follows the rules for a receiver in docs/3-operate/beam.md: it drops the permit when the heartbeat has stood
    still for ``drop_ms``, and then wants to see it withdrawn once.
    """

    drop_ms = RECEIVER_DROP_MS

    def __init__(self, line: SimulatedBeamLine, clock: Clock) -> None:
        self._line, self._clock = line, clock
        self._wants_off_first = False

    def open(self) -> None:
        """Connect."""

    def is_closed(self) -> bool:
        """Whether the contact is closed."""
        is_permitted, beaten_ns = self._line.sent
        if beaten_ns is not None:
            self._wants_off_first |= self._clock.now_ns() - beaten_ns >= self.drop_ms * NS_PER_MS
        elif not is_permitted:
            self._wants_off_first = False
        return is_permitted and not self._wants_off_first

    def close(self) -> None:
        """Disconnect."""


class SimulatedAccelerator:
    """An accelerator whose beam follows a simulated line after ``delay_ms``, both ways, and its beam-on signal.

    Attributes
    ----------
    stuck
        The signal whatever the line does; None for one that follows it.
    """

    def __init__(self, line: SimulatedBeamLine, clock: Clock, *, delay_ms: float) -> None:
        check_number("delay_ms", delay_ms, *ACCELERATOR_BOUNDS_MS, "ms")
        self.stuck: bool | None = None
        self._line, self._clock, self._delay_ns = line, clock, int(delay_ms * NS_PER_MS)
        self._changes: deque[tuple[int, bool]] = deque([(0, False)])

    def read(self) -> bool:
        """Return the signal of now; the line's changes are noticed when it is called."""
        now_ns, is_on = self._clock.now_ns(), self._line.is_on()
        if is_on is not self._changes[-1][1]:
            self._changes.append((now_ns, is_on))
        while len(self._changes) > 1 and self._changes[1][0] + self._delay_ns <= now_ns:
            self._changes.popleft()
        return self._changes[0][1] if self.stuck is None else self.stuck


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
