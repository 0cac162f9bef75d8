"""Faults of the receiver at the other end of the beam line."""

import random
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

from engine.core.clock import NS_PER_MS
from verification.faults.kinds import (
    FRAME_MS,
    LATCHED,
    LINE_MS,
    PERSON_MS,
    RECEIVER_MS,
    Fault,
    FaultKind,
    Inject,
    reported,
)

if TYPE_CHECKING:
    from verification.faults.rig import Rig

FAMILY = "line"
FAILED, MISMATCH = reported("beam_line_failed"), reported("beam_line_mismatch")
REPORT_NS = int((LINE_MS + FRAME_MS) * NS_PER_MS)
"""Found within 200 ms by the line, heard of at the engine's next decision."""

LATE_MS = 180.0


def killed(rig: "Rig", _random: random.Random) -> Fault:
    cause_ns = rig.kill_receiver()
    return Fault(cause_ns=cause_ns, undo=rig.replace_receiver, lasts_s=0.4, reported_by_ns=cause_ns + REPORT_NS)


def frozen(rig: "Rig", chance: random.Random) -> Fault:
    """Freeze it, and judge its contact from when it thaws: while it is frozen nothing but its hardware can open it."""
    begun_ns = time.monotonic_ns()
    rig.receiver.stop()
    time.sleep(chance.uniform(0.4, 1.0))
    thawed_ns = time.monotonic_ns()
    rig.receiver.go_on()
    return Fault(cause_ns=thawed_ns, reported_by_ns=begun_ns + REPORT_NS)


def spoiled(words: str, lasts_s: float = 0.3) -> Inject:
    def inject(rig: "Rig", _random: random.Random) -> Fault:
        cause_ns = time.monotonic_ns()
        rig.receiver.spoil(words)
        return Fault(cause_ns=cause_ns, undo=_well(rig), lasts_s=lasts_s, reported_by_ns=cause_ns + REPORT_NS)

    return inject


def sticks_on(rig: "Rig", _random: random.Random) -> Fault:
    """Let the input read on whatever is commanded; that shows when a person holds the beam."""
    rig.receiver.spoil("stuck on")
    cause_ns = time.monotonic_ns()
    rig.person.act("hold")
    return Fault(cause_ns=cause_ns, undo=_well(rig), lasts_s=0.3, reported_by_ns=cause_ns + REPORT_NS)


def _well(rig: "Rig") -> Callable[[], None]:
    return lambda: rig.receiver.spoil("well")


KINDS = (
    FaultKind(
        code="receiver-killed",
        what="the receiver is killed, another one takes its place",
        family=FAMILY,
        inject=killed,
        reported=FAILED,
        recoveries=LATCHED,
        bound="its contact opens with it",
        is_timed=False,
        bound_ms=FRAME_MS,
    ),
    FaultKind(
        code="receiver-frozen",
        what="the receiver is frozen for 0.4 to 1 s; from when it thaws",
        family=FAMILY,
        inject=frozen,
        reported=FAILED,
        recoveries=LATCHED,
        bound="the receiver's 200 ms",
        bound_ms=RECEIVER_MS,
    ),
    FaultKind(
        code="receiver-late",
        what="it answers 180 ms late",
        family=FAMILY,
        inject=spoiled(f"late {LATE_MS:g}", lasts_s=0.5),
        reported=FAILED,
        recoveries=LATCHED,
        bound="found within 200 ms, then the receiver's own delay",
        bound_ms=LINE_MS + LATE_MS + RECEIVER_MS - 200.0,
    ),
    FaultKind(
        code="receiver-refuses",
        what="it refuses what is written",
        family=FAMILY,
        inject=spoiled("refuse"),
        reported=FAILED,
        recoveries=LATCHED,
        bound="the receiver's 200 ms",
        bound_ms=RECEIVER_MS,
    ),
    FaultKind(
        code="contact-sticks-off",
        what="its contact reads off though commanded on",
        family=FAMILY,
        inject=spoiled("stuck off"),
        reported=MISMATCH,
        recoveries=LATCHED,
        bound="found within 200 ms",
        bound_ms=LINE_MS,
    ),
    FaultKind(
        code="contact-sticks-on",
        what="its contact reads on though a person holds the beam",
        family=FAMILY,
        inject=sticks_on,
        reported=MISMATCH,
        recoveries=LATCHED,
        bound="a person's hold: 100 ms",
        bound_ms=PERSON_MS,
    ),
)
