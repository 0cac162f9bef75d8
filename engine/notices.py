"""What the learning has to tell: models that became ready, took over, or were refused, and why; for the audit."""

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field

Figures = Mapping[str, float | int | str | None]
"""Values by name, unit included."""


class NoticeKind(enum.StrEnum):
    """What has happened."""

    STARTED = "retrain_started"
    READY = "ready"
    SWAPPED = "swapped"
    REFUSED = "refused"
    COMPARED = "compared"
    ZERO_NEEDED = "zero_needed"


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningNotice:
    """One piece of news; ``figures`` are the values it was judged by."""

    kind: NoticeKind
    detail: str
    timestamp_us: int
    figures: Figures = field(default_factory=dict)
