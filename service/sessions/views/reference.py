"""Proposed references for a session's detail."""

from engine.core.learning_status import LearningStatus
from engine.core.reference_proposal import ReferenceMoment, ReferenceProposal
from service.core.finite import rounded_or_none
from service.core.schemas.sessions import ReferenceProposalView

DIGITS = 3


def proposal_views(learning: LearningStatus) -> list[ReferenceProposalView]:
    """Return the positions of the last breaths that a person may make the reference."""
    return [_view(one) for one in learning.reference_proposals]


def _view(one: ReferenceProposal) -> ReferenceProposalView:
    is_inhale = one.moment is ReferenceMoment.END_INHALE
    return ReferenceProposalView(
        at="end_inhale" if is_inhale else "end_exhale",
        signal=one.signal.label,
        unit="l" if one.signal.is_volume else "mm",
        level=round(one.level, DIGITS),
        scatter=round(one.scatter, DIGITS),
        breaths=one.breaths,
        percent=rounded_or_none(one.percent),
    )
