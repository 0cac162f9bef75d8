"""What a plan prescribes about breathing, and whether a session's window is of that technique.

DICOM has one place for it: Motion Synchronization Sequence (300A,0410) in an item of Patient Setup Sequence
(300A,0180), PS3.3 C.8.8.12, with the terms of Respiratory Motion Compensation Technique (0018,9170). No standard
element holds the edges of a window; they are the site's, and never invented here.
"""

from collections.abc import Iterable

from service.plan_schemas import PlanBeam, PlanSetup, Prescribed
from service.window_schemas import Window

NOT_TREATED = frozenset({"SETUP", "OPEN_PORTFILM", "TRMT_PORTFILM"})
OURS: dict[str, Prescribed] = {"BREATH_HOLD": "breath_hold", "GATING": "gating", "UNKNOWN": "unknown"}
SURFACE = frozenset({"EXTERNAL_MARKER", "IMAGE", "BELT", "UNKNOWN", "NONE"})
"""Signals that are the chest's outside, or nothing said."""


def prescribed(beams: Iterable[PlanBeam], setups: Iterable[PlanSetup]) -> Prescribed:
    """Say what these beams are to be treated with."""
    by_beam = [_techniques(beam, list(setups)) for beam in beams if beam.delivery not in NOT_TREATED]
    told = frozenset[str]().union(*by_beam)
    if not told:
        return "not_stated"
    if told == {"NONE"}:
        return "none"
    if told - {"NONE", *OURS}:
        return "other"
    return OURS[next(iter(told))] if len(told) == 1 else "mixed"


def _techniques(beam: PlanBeam, setups: list[PlanSetup]) -> frozenset[str]:
    """Return the terms of a beam's setup; of all setups where it does not say which is its own."""
    own = [setup for setup in setups if beam.setup_number in {None, setup.number}]
    return frozenset(motion.technique for setup in own for motion in setup.motion)


def foreign_signals(setups: Iterable[PlanSetup]) -> list[str]:
    """Return the signals that a plan names and that are not the chest's surface."""
    named = {motion.signal_source for setup in setups for motion in setup.motion if motion.signal_source is not None}
    return sorted(named - SURFACE)


def holds_breath(window: Window) -> bool:
    """Whether the beam can only be on in a held breath."""
    kinds = [condition.kind == "breath_hold" for _, condition in window.conditions()]
    return all(kinds) if window.join == "or" else any(kinds)


def waits_for_breath_hold(window: Window) -> bool:
    """Whether any part of a window is a held breath."""
    return any(condition.kind == "breath_hold" for _, condition in window.conditions())


def mismatch(technique: Prescribed, window: Window) -> str | None:
    """Say what the window would have to be; None where it is of the technique that is prescribed."""
    if technique == "breath_hold":
        return None if holds_breath(window) else "a window that only a breath hold meets, as the plan prescribes"
    if technique == "gating":
        return "a window of amplitude or phase, as the plan prescribes" if waits_for_breath_hold(window) else None
    if technique == "none":
        return "no breath hold: the plan says that it has no compensation" if waits_for_breath_hold(window) else None
    if technique == "mixed":
        return "overridden by a person: the plan's beams are not all of one technique"
    if technique == "other":
        return "overridden by a person: the plan prescribes a technique that is not done here"
    return None


def remark(technique: Prescribed) -> str | None:
    """Say what a person should know of a plan that does not prescribe what Tidegate does."""
    return {
        "not_stated": "the plan prescribes no gating: it says nothing about breathing",
        "none": "the plan prescribes no gating: it says that nothing compensates breathing",
        "unknown": "the plan says that its compensation of breathing is not known",
        "mixed": "the plan's beams are not all of one technique",
        "other": "the plan prescribes a technique that is not done here",
    }.get(technique)
