"""What a kill must leave behind, judged from outside: the receiver's log, the audit after the restart, the files."""

import enum
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from engine.core.clock import NS_PER_MS, NS_PER_S
from verification.campaign.outcomes import TrialOutcome
from verification.faults.kinds import RECEIVER_MS
from verification.faults.verdict import LineEdge, is_on_at

REPORTED_WITHIN_NS = 300 * NS_PER_MS
"""From a decision to the receiver's edge: a lease and a heartbeat's bound are shorter."""

DWELL_NS = 100 * NS_PER_MS
LAST_INSTANT_NS = 30 * NS_PER_MS
"""An off so shortly before the kill is the last hold's, sent and not yet recorded; counted."""

LOST_SAMPLES_NS = NS_PER_S
FRAME_NS = 34 * NS_PER_MS
WATCHDOG = "watchdog"
"""Written by a thread of its own beside the engine's transitions: its states need not connect."""


class Trouble(enum.StrEnum):
    """What was not as promised; the first three hurt."""

    NEVER_OFF = "the line never went off"
    OFF_LATE = "the line went off late"
    ON_UNASKED = "the line came on after the kill"
    ON_UNREPORTED = "the line was on, and the audit does not know"
    NO_DWELL = "the line was on without a dwell"
    OFF_UNREPORTED = "the line went off, and the audit does not know"
    STATES_APART = "a transition is missing between two"
    NUMBERS_APART = "transitions out of order, or twice"
    SAMPLES_LOST = "more than a second of samples is lost"
    AUDIT_BROKEN = "the audit does not verify"
    DATABASE_BROKEN = "the database is damaged"
    NOT_CLOSED = "the session was not closed"
    NOT_READY = "the service is not ready"
    NO_NEW_SESSION = "no new session can be made"
    LEFT_BEHIND = "something half written was left"
    NO_RESULT = "no result"

    @property
    def is_unsafe(self) -> bool:
        """Whether the beam was on when it must not be."""
        return self in {Trouble.NEVER_OFF, Trouble.OFF_LATE, Trouble.ON_UNASKED, Trouble.NO_DWELL}


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """One transition, as the audit has it; ``received_ns`` is when the frame that caused it came."""

    from_state: str
    to_state: str
    reason: str
    decided_ns: int
    number: int
    received_ns: int | None = None
    is_recovered: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """What was seen of one kill.

    Attributes
    ----------
    edges
        The receiver's, from the session's begin until the restarted service had answered for a while.
    measured_from_ns
        From when the session's frames were measured for certain; None where no session ran.
    last_sample_ns
        When the newest frame on file was received.
    status
        The session's, after the restart; empty where there was none.
    stall_ms, stall_before_ms
        How long this machine stood still between kill and off, and between the last edge and the kill, by a process
        that only looks: a line whose engine was not let go on goes off by its lease, and no one has decided anything.
    """

    killed_ns: int
    edges: Sequence[LineEdge] = ()
    steps: Sequence[Step] = ()
    measured_from_ns: int | None = None
    last_sample_ns: int | None = None
    status: str = ""
    is_audit_intact: bool = True
    database_trouble: str = ""
    leftovers: tuple[str, ...] = ()
    is_ready: bool = True
    has_new_session: bool = True
    stall_ms: float = 0.0
    stall_before_ms: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome(TrialOutcome):
    """One kill's result, as it is kept: one line of JSON."""

    number: int
    moment: str
    off_ms: float | None = None
    lost_ms: float | None = None
    edge_ms: float | None = None
    steps: int = 0
    recovered: int = 0
    is_last_instant: bool = False
    restart_s: float = 0.0


def judge(evidence: Evidence) -> tuple[Trouble, ...]:
    """Return all that was not as promised."""
    return (
        *_of_the_line(evidence),
        *_of_its_account(evidence),
        *_of_the_states(evidence.steps),
        *_of_the_rest(evidence),
    )


def off_ms(evidence: Evidence) -> float | None:
    """From the kill to the line off; None where it was off."""
    if not is_on_at(evidence.edges, evidence.killed_ns):
        return None
    gone = next((edge.at_ns for edge in evidence.edges if not edge.is_on and edge.at_ns > evidence.killed_ns), None)
    return None if gone is None else (gone - evidence.killed_ns) / NS_PER_MS


def lost_ms(evidence: Evidence) -> float | None:
    """How much of the session before the kill is on no file."""
    if evidence.measured_from_ns is None:
        return None
    last_ns = max(evidence.last_sample_ns or 0, evidence.measured_from_ns)
    return max(0.0, (evidence.killed_ns - last_ns) / NS_PER_MS)


def edge_ms(evidence: Evidence) -> float | None:
    """How far the kill was from the receiver's nearest edge before it [ms]."""
    before = [edge.at_ns for edge in evidence.edges if edge.at_ns <= evidence.killed_ns]
    return (evidence.killed_ns - before[-1]) / NS_PER_MS if before else None


def is_last_instant(evidence: Evidence) -> bool:
    """Whether the newest off was reported right before the kill, and not kept any more."""
    return any(_excused(edge, evidence) and not _off_is_commanded(edge, evidence.steps) for edge in _offs(evidence))


def _of_the_line(evidence: Evidence) -> Iterator[Trouble]:
    after = [edge for edge in evidence.edges if edge.at_ns > evidence.killed_ns]
    if is_on_at(evidence.edges, evidence.killed_ns):
        took_ms = off_ms(evidence)
        if took_ms is None:
            yield Trouble.NEVER_OFF
        elif took_ms > RECEIVER_MS + evidence.stall_ms:
            yield Trouble.OFF_LATE
    if any(edge.is_on for edge in after):
        yield Trouble.ON_UNASKED


def _of_its_account(evidence: Evidence) -> Iterator[Trouble]:
    for edge in evidence.edges:
        if edge.at_ns > evidence.killed_ns or not edge.is_on:
            continue
        index = _cause_of_on(edge, evidence.steps)
        if index is None:
            yield Trouble.ON_UNREPORTED
        elif not _has_dwelt(evidence.steps, index):
            yield Trouble.NO_DWELL
    for edge in _offs(evidence):
        if not _off_is_commanded(edge, evidence.steps) and not _excused(edge, evidence):
            yield Trouble.OFF_UNREPORTED


def _offs(evidence: Evidence) -> list[LineEdge]:
    return [edge for edge in evidence.edges if not edge.is_on and edge.at_ns <= evidence.killed_ns]


def _excused(edge: LineEdge, evidence: Evidence) -> bool:
    return evidence.killed_ns - edge.at_ns <= LAST_INSTANT_NS + evidence.stall_before_ms * NS_PER_MS


def _cause_of_on(edge: LineEdge, steps: Sequence[Step]) -> int | None:
    found = (
        index
        for index, step in enumerate(steps)
        if step.to_state == "beam_on" and 0 <= edge.at_ns - step.decided_ns <= REPORTED_WITHIN_NS
    )
    return next(found, None)


def _has_dwelt(steps: Sequence[Step], index: int) -> bool:
    """Whether the permit followed a full dwell, counted by when the frames of both came, as the gate counts it."""
    before = steps[index - 1] if index else None
    if before is None or before.to_state != "dwell" or before.received_ns is None:
        return False
    received_ns = steps[index].received_ns
    return received_ns is not None and received_ns - before.received_ns >= DWELL_NS


def _off_is_commanded(edge: LineEdge, steps: Sequence[Step]) -> bool:
    return any(
        step.from_state == "beam_on" and abs(edge.at_ns - step.decided_ns) <= REPORTED_WITHIN_NS for step in steps
    )


def _of_the_states(steps: Sequence[Step]) -> Iterator[Trouble]:
    if not _do_join(steps):
        yield Trouble.STATES_APART
    if any(one.number >= other.number for one, other in itertools.pairwise(steps)):
        yield Trouble.NUMBERS_APART


def _do_join(steps: Sequence[Step]) -> bool:
    """Whether each begins where the one before it ended; a watchdog's fault comes in between, and is taken up later."""
    state, has_fired = "disarmed", False
    for step in steps:
        if step.reason == WATCHDOG and step.to_state == "fault":
            has_fired = True
            continue
        if step.from_state != state and not (has_fired and step.from_state == "fault"):
            return False
        has_fired = has_fired and step.from_state != "fault"
        state = step.to_state
    return True


def _of_the_rest(evidence: Evidence) -> Iterator[Trouble]:
    lost = lost_ms(evidence)
    if lost is not None and lost > (LOST_SAMPLES_NS + FRAME_NS) / NS_PER_MS + evidence.stall_ms:
        yield Trouble.SAMPLES_LOST
    if not evidence.is_audit_intact:
        yield Trouble.AUDIT_BROKEN
    if evidence.database_trouble:
        yield Trouble.DATABASE_BROKEN
    if evidence.status == "running":
        yield Trouble.NOT_CLOSED
    if not evidence.is_ready:
        yield Trouble.NOT_READY
    if not evidence.has_new_session:
        yield Trouble.NO_NEW_SESSION
    if evidence.leftovers:
        yield Trouble.LEFT_BEHIND
