"""Events of the training: models that became ready, became active or were refused, and why; for the audit."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field

from engine.core.first_reference import FirstReference

Figures = Mapping[str, float | int | str | None]
"""Values by name, unit included."""


class LearningEventKind(enum.StrEnum):
    """What has happened."""

    STARTED = "retrain_started"
    READY = "ready"
    SWAPPED = "swapped"
    REFUSED = "refused"
    COMPARED = "compared"
    ZERO_NEEDED = "zero_needed"
    REFERENCE_SET = "reference_set"


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningEvent:
    """One event; ``figures`` are the values that decided it, ``first`` the first reference where it became known."""

    kind: LearningEventKind
    detail: str
    timestamp_us: int
    figures: Figures = field(default_factory=dict)
    first: FirstReference | None = None
