"""One trial: the beam on, a random moment, the fault, the line off, the cause gone, the beam back; judged."""

import contextlib
import math
import random
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from engine.core.clock import NS_PER_MS, NS_PER_S
from verification.faults.kinds import Fault, FaultKind, MissedError
from verification.faults.recovery import WayBack
from verification.faults.verdict import (
    FAULTS,
    REASONS,
    Evidence,
    Expectation,
    LineEdge,
    Outcome,
    Reported,
    Trouble,
    came_back,
    is_on_at,
    judge,
    off_after_ms,
    reported_as,
)

if TYPE_CHECKING:
    from verification.faults.rig import Rig

STEADY_S = (0.15, 0.9)
"""How long the beam is on before the fault, at random."""

STAYS_OFF_S = 0.35
"""Longer than a dwell and several frames: what may come back by itself would."""

GIVE_UP_S = 3.0
TRIES = 6
DISTURBED_TRIES = 6
STALL_MS = 20.0
"""A machine that stood still for so long had that much less time to take a line off, and no more than that."""

OF_ANOTHER_CAUSE = {Trouble.UNREPORTED, Trouble.OTHER_RECOVERY, Trouble.ON_UNASKED}
"""All that may be wrong where the beam went off in time for something else, a hold that ends by itself among them."""

REPORTED_WAIT_S = 2.0
SLOW_MS = 300.0
LONGEST_ON_S = 3.0
"""Beam-on in a session from which the next trial gets another one: two breaths of the volunteer are eight seconds."""
NEAR_NS = 60 * NS_PER_MS


@dataclass(slots=True)
class Judged:
    """One try's evidence, and what was promised of it."""

    expected: Expectation
    evidence: Evidence
    troubles: list[Trouble] = field(default_factory=list)


def run_trial(rig: "Rig", kind: FaultKind, seed: int) -> Outcome:
    """Try a kind of fault once, with everything random following from the seed; again where nothing can be said."""
    began_s = time.monotonic()
    disturbed: list[float] = []
    missed = 0
    while True:
        chance = random.Random(f"{kind.code} {seed} {missed} {len(disturbed)}")
        try:
            judged = _try_once(rig, kind, chance)
        except MissedError as error:
            missed += 1
            if missed >= TRIES:
                return _no_result(kind, seed, str(error))
            continue
        off_ms = off_after_ms(judged.evidence)
        if kind.may_be_disturbed and _is_disturbed(judged) and len(disturbed) < DISTURBED_TRIES:
            disturbed.append(off_ms or 0.0)
            continue
        return Outcome(
            kind=kind.code,
            seed=seed,
            off_ms=off_ms if kind.is_timed and math.isfinite(judged.expected.bound_ms) else None,
            troubles=tuple(judged.troubles),
            reported=reported_as(judged.expected, judged.evidence),
            recovery=came_back(judged.evidence) or "",
            stall_ms=judged.evidence.stall_ms,
            disturbed_ms=tuple(disturbed),
            missed=missed,
            note=_note(judged),
            seconds=time.monotonic() - began_s,
        )


def _is_disturbed(judged: Judged) -> bool:
    """Whether it was late and nothing else, by no more than this machine stood still between cause and off."""
    off_ms, stall_ms = off_after_ms(judged.evidence), judged.evidence.stall_ms
    is_late_alone = judged.troubles == [Trouble.OFF_LATE] and off_ms is not None
    return is_late_alone and stall_ms >= STALL_MS and off_ms - judged.expected.bound_ms <= stall_ms


def _no_result(kind: FaultKind, seed: int, note: str) -> Outcome:
    return Outcome(
        kind=kind.code, seed=seed, off_ms=None, troubles=(Trouble.NO_RESULT,), reported=(), recovery="", note=note
    )


def _try_once(rig: "Rig", kind: FaultKind, chance: random.Random) -> Judged:
    _reach_steady_beam(rig, chance)
    sequence = rig.ledger.newest()
    fault = kind.inject(rig, chance)
    try:
        cause_ns = _await_off(rig, kind, fault)
        time.sleep(fault.lasts_s)
        fault.meanwhile()
    except BaseException:
        fault.undo()
        raise
    clear_ns = fault.undo()
    way = WayBack(rig)
    time.sleep(STAYS_OFF_S)
    recovery, edges = way.walk(), rig.edges
    expected = replace(kind.expected, bound_ms=math.inf) if fault.is_of_itself else kind.expected
    gone = [edge.at_ns for edge in edges if not edge.is_on and edge.at_ns >= cause_ns]
    evidence = Evidence(
        cause_ns=cause_ns,
        edges=[edge for edge in edges if edge.at_ns >= cause_ns],
        reported=_reported_since(rig, sequence, expected),
        recovery=recovery,
        clear_ns=cause_ns if fault.is_step else clear_ns,
        armed_ns=way.asked_ns,
        acted_ns=way.acted_ns,
        reported_by_ns=fault.reported_by_ns,
        is_chain_intact=_is_chain_intact(rig),
        stall_ms=rig.watchman.stalled_ms(cause_ns, gone[0] if gone else time.monotonic_ns()),
    )
    judged = Judged(expected=expected, evidence=evidence, troubles=judge(expected, evidence))
    _refuse_another_s(judged, gone)
    return judged


def _refuse_another_s(judged: Judged, gone: list[int]) -> None:
    """Raise MissedError where the beam went off in time, and the audit says that it did for something else.

    What may take a second to be found leaves time for that: then nothing that came after is an answer.
    """
    expected, evidence = judged.expected, judged.evidence
    is_in_time = bool(gone) and Trouble.OFF_LATE not in judged.troubles
    is_slow = math.isfinite(expected.bound_ms) and expected.bound_ms > SLOW_MS
    is_of_another = Trouble.UNREPORTED in judged.troubles and set(judged.troubles) <= OF_ANOTHER_CAUSE
    if not is_in_time or not (is_slow or is_of_another):
        return
    near = {one.what for one in evidence.reported if one.what in REASONS and abs(one.at_ns - gone[0]) < NEAR_NS}
    is_back_by_right = Trouble.ON_UNASKED not in judged.troubles or not near & FAULTS
    if near and not near & expected.reported and is_back_by_right:
        raise MissedError(f"the beam went off for another reason: {', '.join(sorted(near))}")


def _reach_steady_beam(rig: "Rig", chance: random.Random) -> None:
    if rig.beam_on_s > LONGEST_ON_S:
        rig.person.act("stop")  # the way back makes another session
    way = WayBack(rig)
    if way.walk() is None:
        raise MissedError(f"the beam does not come on: {way.refusal}")
    time.sleep(chance.uniform(*STEADY_S))
    if not rig.is_on:
        raise MissedError("the beam did not stay on")


def _await_off(rig: "Rig", kind: FaultKind, fault: Fault) -> int:
    """Wait until the receiver is off for the fault; return when its cause was there; raise MissedError if too early."""
    end_ns = fault.cause_ns + int((kind.bound_ms + GIVE_UP_S * 1000) * NS_PER_MS)
    while time.monotonic_ns() < end_ns and not _has_gone_off(rig.edges, fault.begun_ns or fault.cause_ns):
        time.sleep(0.005)
    cause_ns = fault.cause_ns
    if fault.find_cause is not None:
        cause_ns = _found(fault) or cause_ns
    if not fault.is_of_itself and not is_on_at(rig.edges, cause_ns):
        raise MissedError("the beam went off before the fault")
    return cause_ns


def _found(fault: Fault) -> int | None:
    """Look the cause up; it is written down a moment later."""
    assert fault.find_cause is not None
    end_s = time.monotonic() + REPORTED_WAIT_S
    while (found := fault.find_cause()) is None and time.monotonic() < end_s:
        time.sleep(0.05)
    return found


def _has_gone_off(edges: list[LineEdge], cause_ns: int) -> bool:
    return any(not edge.is_on and edge.at_ns >= cause_ns for edge in edges)


def _reported_since(rig: "Rig", sequence: int, expected: Expectation) -> list[Reported]:
    """Read the account; what is written last may take a moment."""
    end_s = time.monotonic() + REPORTED_WAIT_S
    while True:
        reported = rig.ledger.reported_since(sequence)
        if any(one.what in expected.reported for one in reported) or time.monotonic() > end_s:
            return reported
        time.sleep(0.05)


def _is_chain_intact(rig: "Rig") -> bool:
    for _ in range(3):
        with contextlib.suppress(Exception):
            return rig.person.is_chain_intact()
        time.sleep(0.3)
    return False


def _note(judged: Judged) -> str:
    if not judged.troubles:
        return ""
    evidence = judged.evidence
    began_ns = evidence.cause_ns
    edges = " ".join(
        f"{'on' if edge.is_on else 'off'}@{(edge.at_ns - began_ns) / NS_PER_S:.3f}" for edge in evidence.edges[:6]
    )
    reported = " ".join(f"{one.what}@{(one.at_ns - began_ns) / NS_PER_S:.3f}" for one in evidence.reported[:8])
    cleared = "" if evidence.clear_ns is None else f" clear@{(evidence.clear_ns - began_ns) / NS_PER_S:.3f}"
    asked = "" if evidence.armed_ns is None else f" asked@{(evidence.armed_ns - began_ns) / NS_PER_S:.3f}"
    return f"line {edges}{cleared}{asked} audit {reported} recovery {evidence.recovery or 'none'}"
