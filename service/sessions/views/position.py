"""The patient's position against the plan's, for people and programs.

Proposed references, and the distance of the one in use from the fraction's first, for people and programs.
"""

import math

from engine.control import LiveView, PositionState
from engine.core.learning_status import LearningStatus
from engine.core.position_check import Degree, PositionCheck, PositionTolerance
from engine.core.reference import ReferenceDistance, ReferenceMoment, ReferenceProposal
from engine.core.sentences import say
from service.core.schemas.base import rounded_or_none
from service.core.schemas.live_messages import LiveDegree, LivePositionCheck, LiveReference
from service.core.schemas.sessions import ReferenceProposalView
from service.core.settings.settings import Settings
from service.engine_host.protocols import SessionPlan

DIGITS = 2
FIRST_FRACTION = say("first fraction of the plan: the confirmed reference becomes the plan's position")
NO_REFERENCE = say("set the reference: its position is then compared with the plan's")
REFERENCE_DIGITS = 3


def tolerance_of(settings: Settings) -> PositionTolerance:
    """Return the site's tolerance."""
    return PositionTolerance(
        shift_mm=settings.max_position_shift_mm,
        turn_deg=settings.max_position_turn_deg,
        shape_mm=settings.max_position_shape_mm,
    )


def degree_views(check: PositionCheck | None, tolerance: PositionTolerance) -> list[LiveDegree]:
    """Return the six degrees of freedom; empty where nothing is compared, or nothing can be."""
    if check is None or check.unknown:
        return []
    return [_degree(one, tolerance) for one in check.degrees]


def live_position_check(view: LiveView, plan: SessionPlan) -> LivePositionCheck | None:
    """Return the position of the reference in use, and who signed it."""
    found = view.position
    if found is None:
        return None
    signature, check = found.signature, found.check
    return LivePositionCheck(
        status=_status(found),
        text=position_text(found),
        plan_session_id=plan.plan_session_id,
        reference_number=found.reference_number,
        degrees=degree_views(check, found.tolerance),
        shape_mm=None if check is None else rounded_or_none(check.shape_mm, DIGITS),
        is_within=check is not None and not found.shortcomings,
        shortcomings=list(found.shortcomings),
        signed_by=None if signature is None else signature.operator,
        reason="" if signature is None else signature.reason,
        lapse=found.lapse,
    )


def position_text(found: PositionState) -> str:
    """Return the position as it is displayed."""
    if not found.is_required:
        return FIRST_FRACTION
    if found.reference_number is None:
        return NO_REFERENCE
    if found.lapse:
        return say("position to be taken again: {lapse}", lapse=found.lapse)
    place = (
        say("not within the tolerance ({shortcomings})", shortcomings=", ".join(found.shortcomings))
        if found.shortcomings
        else say("within tolerance")
    )
    signed = (
        say("not signed") if found.signature is None else say("signed by {operator}", operator=found.signature.operator)
    )
    return say("position {place}, {signed}", place=place, signed=signed)


def _status(found: PositionState) -> str:
    if not found.is_required:
        return "first_fraction"
    if found.reference_number is None:
        return "no_reference"
    if found.lapse:
        return "lapsed"
    return "unsigned" if found.signature is None else "signed"


def _degree(one: Degree, tolerance: PositionTolerance) -> LiveDegree:
    return LiveDegree(
        name=one.name,
        unit=one.unit,
        value=rounded_or_none(one.value, DIGITS) if tolerance.determines(one) else None,
        uncertainty=rounded_or_none(one.uncertainty, DIGITS),
        tolerance=tolerance.of(one),
        is_within=tolerance.holds(one),
    )


def proposal_views(
    learning: LearningStatus, budget_mm: float, tolerance: PositionTolerance
) -> list[ReferenceProposalView]:
    """Return the positions of the last breaths that a person may make the reference; those beyond need a reason."""
    return [_view(one, budget_mm, tolerance) for one in learning.reference_proposals]


def live_reference(view: LiveView) -> LiveReference | None:
    """Return how far reference and window lie from the fraction's first reference; None without a reference."""
    found = view.reference_distance
    if found is None:
        return None
    level = found.corrected_levels[0].level if found.corrected_levels else None
    names = ("moved_mm", "shift_mm", "height_mm", "turn_deg", "tilt_deg", "shape_mm", "uncertainty_mm")
    return LiveReference(
        text=reference_text(found),
        distance_mm=_rounded(found.distance_mm),
        budget_mm=view.reference_budget_mm,
        is_beyond=not found.is_within(view.reference_budget_mm),
        level=_rounded(level),
        correction=round(found.correction, REFERENCE_DIGITS),
        unit="l" if view.window.choices[0].is_volume else "mm",
        unknown=found.unknown,
        **{name: _rounded(getattr(found, name)) for name in names},
    )


def reference_text(found: ReferenceDistance) -> str:
    """Return the distance as it is displayed."""
    if found.distance_mm is None:
        return say("reference at an unknown distance from the fraction's first")
    text = say("reference {distance_mm:.1f} mm from the fraction's first", distance_mm=found.distance_mm)
    if not math.isfinite(found.uncertainty_mm):
        return text
    return say("{text}, uncertain by {uncertainty_mm:.1f} mm", text=text, uncertainty_mm=found.uncertainty_mm)


def _rounded(value: float | None) -> float | None:
    return rounded_or_none(value, REFERENCE_DIGITS)


def _view(one: ReferenceProposal, budget_mm: float, tolerance: PositionTolerance) -> ReferenceProposalView:
    is_inhale = one.moment is ReferenceMoment.END_INHALE
    return ReferenceProposalView(
        at="end_inhale" if is_inhale else "end_exhale",
        signal=one.signal.label,
        unit="l" if one.signal.is_volume else "mm",
        level=round(one.level, REFERENCE_DIGITS),
        scatter=round(one.scatter, REFERENCE_DIGITS),
        breaths=one.breaths,
        percent=rounded_or_none(one.percent),
        distance=None if one.distance is None else one.distance.text,
        distance_mm=None if one.distance is None else _rounded(one.distance.distance_mm),
        is_beyond=one.distance is not None and not one.distance.is_within(budget_mm),
        position=degree_views(one.position_check, tolerance),
    )
