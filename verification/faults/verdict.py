"""What a trial showed, and the judgement of it: a pure function, so that planted evidence can try it.

All times are host monotonic [ns], which every process of this machine shares.
"""

import enum
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from engine.core.clock import NS_PER_MS
from engine.core.gate_state import HoldReason
from verification.campaign.outcomes import TrialOutcome

REASONS = {reason.value for reason in HoldReason} - {HoldReason.DWELL.value}
FAULTS = {reason.value for reason in HoldReason if reason.is_fault}
DWELL_NS = 100 * NS_PER_MS
"""The dwell of the campaign's window: no hold ends sooner after its cause is gone."""


class Recovery(enum.StrEnum):
    """How the beam came back."""

    BY_ITSELF = "by itself"
    RELEASED = "released"
    ARMED = "armed"
    ACKNOWLEDGED = "acknowledged, armed"
    NEW_SESSION = "new session"
    RESTARTED = "service restarted"


class Trouble(enum.StrEnum):
    """What makes a cell red. The first four are unsafe, the rest are promises that were not kept."""

    NEVER_OFF = "never off"
    OFF_LATE = "off late"
    BACK_EARLY = "back on early"
    ON_UNASKED = "on though nobody armed"
    UNREPORTED = "not reported"
    REPORTED_LATE = "reported late"
    CHAIN_BROKEN = "audit chain broken"
    NOT_RECOVERED = "does not recover"
    OTHER_RECOVERY = "recovers otherwise"
    NO_RESULT = "no result"
    SERVICE_DIED = "the service died"

    @property
    def is_unsafe(self) -> bool:
        """Whether the line was on when it must not be."""
        return self in {Trouble.NEVER_OFF, Trouble.OFF_LATE, Trouble.BACK_EARLY, Trouble.ON_UNASKED}


@dataclass(frozen=True, slots=True, kw_only=True)
class LineEdge:
    """One edge of the receiver's own log."""

    is_on: bool
    at_ns: int
    cause: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reported:
    """One row of the audit that says why: a transition's reason, or an action."""

    what: str
    at_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Expectation:
    """What a kind of fault promises.

    Attributes
    ----------
    bound_ms
        From the cause to the line off.
    reported
        What the audit may call it; one of these has to be there.
    recoveries
        The ways in which the beam may come back.
    """

    bound_ms: float
    reported: frozenset[str]
    recoveries: frozenset[Recovery]


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What was seen of one fault.

    Attributes
    ----------
    cause_ns
        When the fault was there.
    clear_ns
        When its cause was gone again; None where that is the cause's own time.
    armed_ns
        When a person asked for the beam again; None where no one had to.
    acted_ns
        When a person did anything at all on the way back; what the audit says from then on is not the fault's account.
    edges
        The receiver's log, from the on that the fault ended to the next.
    reported_by_ns
        Until when the audit's account must have been given; None does not ask.
    stall_ms
        How long this machine stood still between cause and off, by a process that only looks.
    """

    cause_ns: int
    edges: Sequence[LineEdge]
    reported: Sequence[Reported]
    recovery: Recovery | None
    clear_ns: int | None = None
    armed_ns: int | None = None
    acted_ns: int | None = None
    reported_by_ns: int | None = None
    is_chain_intact: bool = True
    stall_ms: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome(TrialOutcome):
    """One trial's result, as it is kept: one line of JSON."""

    kind: str
    seed: int
    off_ms: float | None
    reported: tuple[str, ...]
    recovery: str
    stall_ms: float = 0.0
    disturbed_ms: tuple[float, ...] = ()
    missed: int = 0

    @property
    def is_unsafe(self) -> bool:
        """Whether the line was on when it must not be."""
        return any(Trouble(one).is_unsafe for one in self.troubles)


def is_on_at(edges: Iterable[LineEdge], at_ns: int) -> bool:
    """Whether the receiver had the beam on at a time."""
    before = [edge for edge in edges if edge.at_ns <= at_ns]
    return bool(before) and before[-1].is_on


def off_ns(evidence: Evidence) -> int | None:
    """When the line went off for the fault; None if it never did."""
    return next((edge.at_ns for edge in evidence.edges if not edge.is_on and edge.at_ns >= evidence.cause_ns), None)


def off_after_ms(evidence: Evidence) -> float | None:
    """From the cause to the line off, as the receiver saw it."""
    gone_ns = off_ns(evidence)
    return None if gone_ns is None else (gone_ns - evidence.cause_ns) / NS_PER_MS


def judge(expected: Expectation, evidence: Evidence) -> list[Trouble]:
    """Return all that was not as promised; nothing where everything was."""
    return [
        *_of_the_line(expected, evidence),
        *_of_the_account(expected, evidence),
        *_of_the_recovery(expected, evidence),
    ]


def reported_as(expected: Expectation, evidence: Evidence) -> tuple[str, ...]:
    """What the audit called it, of what it may."""
    return tuple(dict.fromkeys(one.what for one in evidence.reported if one.what in expected.reported))


def came_back(evidence: Evidence) -> Recovery | None:
    """How the beam came back: by itself where it was on before anyone had asked for it."""
    on_ns = _on_again_ns(evidence)
    is_asked_for = evidence.armed_ns is not None and on_ns is not None and on_ns >= evidence.armed_ns
    return evidence.recovery if on_ns is None or is_asked_for else Recovery.BY_ITSELF


def _on_again_ns(evidence: Evidence) -> int | None:
    gone_ns = off_ns(evidence)
    on_ns = (edge.at_ns for edge in evidence.edges if edge.is_on and gone_ns is not None and edge.at_ns > gone_ns)
    return next(on_ns, None)


def _of_the_line(expected: Expectation, evidence: Evidence) -> list[Trouble]:
    took_ms = off_after_ms(evidence)
    if took_ms is None:
        return [Trouble.NEVER_OFF]
    found = [Trouble.OFF_LATE] if took_ms > expected.bound_ms else []
    on_ns = _on_again_ns(evidence)
    if on_ns is None:
        return found
    may_come_back = Recovery.BY_ITSELF in expected.recoveries and not _has_latched(evidence, on_ns)
    if came_back(evidence) is Recovery.BY_ITSELF and not may_come_back:
        found.append(Trouble.ON_UNASKED)
    clear_ns = evidence.cause_ns if evidence.clear_ns is None else evidence.clear_ns
    return found + ([Trouble.BACK_EARLY] if on_ns < clear_ns + DWELL_NS else [])


def _has_latched(evidence: Evidence, before_ns: int) -> bool:
    """Whether a fault was reported by then."""
    return any(one.what in FAULTS and evidence.cause_ns <= one.at_ns < before_ns for one in evidence.reported)


def _of_the_account(expected: Expectation, evidence: Evidence) -> list[Trouble]:
    found = [
        one.at_ns for one in evidence.reported if one.what in expected.reported and _is_of_the_fault(one, evidence)
    ]
    troubles = [] if found else [Trouble.UNREPORTED]
    if found and evidence.reported_by_ns is not None and min(found) > evidence.reported_by_ns:
        troubles.append(Trouble.REPORTED_LATE)
    return troubles + ([] if evidence.is_chain_intact else [Trouble.CHAIN_BROKEN])


def _is_of_the_fault(one: Reported, evidence: Evidence) -> bool:
    """Whether a row may be the fault's account: no reason is, written after anyone acted or the beam was back."""
    ends = [end for end in (evidence.acted_ns, evidence.armed_ns, _on_again_ns(evidence)) if end is not None]
    return one.what not in REASONS or one.at_ns <= min(ends, default=one.at_ns)


def _of_the_recovery(expected: Expectation, evidence: Evidence) -> list[Trouble]:
    recovery = came_back(evidence)
    if recovery is None:
        return [Trouble.NOT_RECOVERED]
    return [] if recovery in expected.recoveries or _is_for_another(expected, evidence) else [Trouble.OTHER_RECOVERY]


def _is_for_another(expected: Expectation, evidence: Evidence) -> bool:
    """Whether somebody acknowledged a fault of the machine's own, which had nothing to do with this one."""
    others = FAULTS - expected.reported
    return came_back(evidence) is Recovery.ACKNOWLEDGED and any(one.what in others for one in evidence.reported)
