"""The motion compensation that a plan prescribes, and whether a session's window matches it.

In DICOM it is in Motion Synchronization Sequence (300A,0410) in an item of Patient Setup Sequence
(300A,0180), PS3.3 C.8.8.12, with the terms of Respiratory Motion Compensation Technique (0018,9170). No standard
element holds the edges of a window; they are the site's, and never invented here.
"""

from collections.abc import Iterable

from service.core.schemas.plans import PlanBeam, PlanSetup, Prescribed
from service.core.schemas.windows import Window

NOT_TREATED = frozenset({"SETUP", "OPEN_PORTFILM", "TRMT_PORTFILM"})
TECHNIQUES: dict[str, Prescribed] = {"BREATH_HOLD": "breath_hold", "GATING": "gating", "UNKNOWN": "unknown"}
SURFACE = frozenset({"EXTERNAL_MARKER", "IMAGE", "BELT", "UNKNOWN", "NONE"})
"""Signal sources on the chest's surface, or not specified."""


def prescribed(beams: Iterable[PlanBeam], setups: Iterable[PlanSetup]) -> Prescribed:
    """Return the technique prescribed for the treatment beams."""
    by_beam = [_techniques(beam, list(setups)) for beam in beams if beam.delivery not in NOT_TREATED]
    terms = frozenset[str]().union(*by_beam)
    if not terms:
        return "not_stated"
    if terms == {"NONE"}:
        return "none"
    if terms - {"NONE", *TECHNIQUES}:
        return "other"
    return TECHNIQUES[next(iter(terms))] if len(terms) == 1 else "mixed"


def _techniques(beam: PlanBeam, setups: list[PlanSetup]) -> frozenset[str]:
    """Return the technique terms of a beam's setup; of all setups if the beam refers to none."""
    own = [setup for setup in setups if beam.setup_number in {None, setup.number}]
    return frozenset(motion.technique for setup in own for motion in setup.motion)


def foreign_signals(setups: Iterable[PlanSetup]) -> list[str]:
    """Return the plan's signal sources that are not on the chest's surface."""
    named = {motion.signal_source for setup in setups for motion in setup.motion if motion.signal_source is not None}
    return sorted(named - SURFACE)


def holds_breath(window: Window) -> bool:
    """Whether the window requires a breath hold for beam on."""
    kinds = [condition.kind == "breath_hold" for _, condition in window.conditions()]
    return all(kinds) if window.join == "or" else any(kinds)


def waits_for_breath_hold(window: Window) -> bool:
    """Whether any condition of a window is a breath hold."""
    return any(condition.kind == "breath_hold" for _, condition in window.conditions())


def mismatch(technique: Prescribed, window: Window) -> str | None:
    """Return the required kind of window; None if the window matches the prescribed technique."""
    if technique == "breath_hold":
        return None if holds_breath(window) else "a window that only a breath hold meets, as the plan prescribes"
    if technique == "gating":
        return "a window of amplitude or phase, as the plan prescribes" if waits_for_breath_hold(window) else None
    if technique == "none":
        return (
            "without breath hold: the plan prescribes no motion compensation" if waits_for_breath_hold(window) else None
        )
    if technique == "mixed":
        return "overridden by a person: the plan's beams have different techniques"
    if technique == "other":
        return "overridden by a person: the plan prescribes a technique that Tidegate does not support"
    return None


def remark(technique: Prescribed) -> str | None:
    """Return a note on a plan that prescribes neither gating nor breath hold; None otherwise."""
    return {
        "not_stated": "the plan prescribes no gating: it has no motion compensation element",
        "none": "the plan prescribes no gating: its motion compensation is NONE",
        "unknown": "the plan's motion compensation is UNKNOWN",
        "mixed": "the plan's beams have different techniques",
        "other": "the plan prescribes a technique that Tidegate does not support",
    }.get(technique)
