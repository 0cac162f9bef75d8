"""A kind of fault: what it is, how it is injected, what it promises; and the list of all."""

import random
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from verification.faults.plan import DEFAULT_PLAN, Plan
from verification.faults.verdict import Expectation, Recovery

if TYPE_CHECKING:
    from verification.faults.rig import Rig

FRAME_MS = 100.0
"""What frames show has the line off within this, as the issue asks."""

LEASE_MS = 80.0
LAG_MS = 100.0
"""A frame may come so much later than the promptest and still be believed."""

RECEIVER_MS = 210.0
"""The receiver drops when the heartbeat has stood still for 200 ms; it looks every 5 ms."""

LINE_MS = 200.0
"""Every trouble of the line is held and latched within this."""

PERSON_MS = 100.0
BY_ITSELF = frozenset({Recovery.BY_ITSELF, Recovery.ACKNOWLEDGED})
"""A hold: it may come back by itself, and may have become a fault meanwhile."""

LATCHED = frozenset({Recovery.ACKNOWLEDGED})
NEW_SESSION = frozenset({Recovery.NEW_SESSION})
RESTARTED = frozenset({Recovery.RESTARTED})
ARMED = frozenset({Recovery.ARMED})


class MissedError(Exception):
    """The beam was off by itself when the fault came: no result, try again."""


def nothing() -> int | None:
    """Undo a fault that goes by itself."""
    return None


def always() -> bool:
    """Say that a fault stays until it is undone."""
    return True


@dataclass(frozen=True, slots=True, kw_only=True)
class Fault:
    """One fault as it was injected.

    Attributes
    ----------
    cause_ns
        When it was there.
    undo
        Takes it away; may return when the first good frame came.
    lasts_s
        How long it stays once the line is off.
    meanwhile
        What somebody does while it stays.
    reported_by_ns
        Until when the audit's account has to be given; None does not ask.
    find_cause
        Looks the cause's time up afterwards, where only then it can be known; ``cause_ns`` is the latest it may be.
    begun_ns
        When what leads to the cause began, where that is earlier.
    is_of_itself
        The beam went off before anything was there that had to take it off: safe, and bound to no time.
    is_going
        Whether it is still there, asked when the fault beside it came.
    is_step
        The cause is over as soon as it was there, and to undo it is a fault of its own: the beam may be back before.
    """

    cause_ns: int
    undo: Callable[[], int | None] = nothing
    lasts_s: float = 0.0
    meanwhile: Callable[[], object] = nothing
    reported_by_ns: int | None = None
    find_cause: Callable[[], int | None] | None = None
    begun_ns: int | None = None
    is_of_itself: bool = False
    is_step: bool = False
    is_going: Callable[[], bool] = always


Inject = Callable[["Rig", random.Random], Fault]


@dataclass(frozen=True, slots=True, kw_only=True)
class FaultKind:
    """See the module.

    Attributes
    ----------
    bound
        In words, where the bound is from.
    bound_ms, reported, recoveries
        See :class:`verification.faults.verdict.Expectation`.
    plan
        What kind of service it needs.
    may_be_disturbed
        Whether a trial that is late on a machine which stood still is done again; not where that is the fault.
    is_timed
        Whether the receiver itself saw the line go off; a killed one saw nothing.
    """

    code: str
    what: str
    family: str
    inject: Inject
    reported: frozenset[str]
    recoveries: frozenset[Recovery]
    bound: str = "what frames show: 100 ms"
    bound_ms: float = FRAME_MS
    plan: Plan = field(default=DEFAULT_PLAN)
    may_be_disturbed: bool = True
    is_timed: bool = True

    @property
    def expected(self) -> Expectation:
        return Expectation(bound_ms=self.bound_ms, reported=self.reported, recoveries=self.recoveries)


def reported(*names: str) -> frozenset[str]:
    return frozenset(names)


def all_kinds() -> tuple[FaultKind, ...]:
    """Every kind there is, family by family."""
    from verification.faults import (
        frame_faults,
        host_faults,
        line_faults,
        malformed_frames,
        people_faults,
        process_faults,
    )

    found = (
        *frame_faults.KINDS,
        *malformed_frames.KINDS,
        *process_faults.KINDS,
        *host_faults.KINDS,
        *line_faults.KINDS,
        *people_faults.KINDS,
    )
    codes = [kind.code for kind in found]
    assert len(codes) == len(set(codes)), "a code stands for one kind"
    return found


def chosen(names: Iterable[str]) -> tuple[FaultKind, ...]:
    """The kinds of these names, in the list's order; raise ValueError for a name that is none."""
    wanted = set(names)
    found = tuple(kind for kind in all_kinds() if kind.code in wanted)
    unknown = sorted(wanted - {kind.code for kind in found})
    if unknown:
        msg = f"no such kind: {', '.join(unknown)}"
        raise ValueError(msg)
    return found
