"""Proposed references, and the distance of the one in use from the fraction's first, for people and programs."""

from engine.control import LiveView
from engine.core.learning_status import LearningStatus
from engine.core.position_check import PositionTolerance
from engine.core.reference_distance import ReferenceDistance
from engine.core.reference_proposal import ReferenceMoment, ReferenceProposal
from service.core.finite import rounded_or_none
from service.core.schemas.live_messages import LiveReference
from service.core.schemas.sessions import ReferenceProposalView
from service.sessions.views.position import degree_views

DIGITS = 3


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
    names = ("moved_mm", "shift_mm", "height_mm", "turn_deg", "tilt_deg", "shape_mm")
    return LiveReference(
        text=reference_text(found),
        distance_mm=_rounded(found.distance_mm),
        budget_mm=view.reference_budget_mm,
        is_beyond=not found.is_within(view.reference_budget_mm),
        level=_rounded(level),
        correction=round(found.correction, DIGITS),
        unit="l" if view.window.choices[0].is_volume else "mm",
        unknown=found.unknown,
        **{name: _rounded(getattr(found, name)) for name in names},
    )


def reference_text(found: ReferenceDistance) -> str:
    """Return the distance as it is displayed."""
    if found.distance_mm is None:
        return "reference at an unknown distance from the fraction's first"
    return f"reference {found.distance_mm:.1f} mm from the fraction's first"


def _rounded(value: float | None) -> float | None:
    return rounded_or_none(value, DIGITS)


def _view(one: ReferenceProposal, budget_mm: float, tolerance: PositionTolerance) -> ReferenceProposalView:
    is_inhale = one.moment is ReferenceMoment.END_INHALE
    return ReferenceProposalView(
        at="end_inhale" if is_inhale else "end_exhale",
        signal=one.signal.label,
        unit="l" if one.signal.is_volume else "mm",
        level=round(one.level, DIGITS),
        scatter=round(one.scatter, DIGITS),
        breaths=one.breaths,
        percent=rounded_or_none(one.percent),
        distance=None if one.distance is None else one.distance.text,
        distance_mm=None if one.distance is None else _rounded(one.distance.distance_mm),
        is_beyond=one.distance is not None and not one.distance.is_within(budget_mm),
        position=degree_views(one.position_check, tolerance),
    )
