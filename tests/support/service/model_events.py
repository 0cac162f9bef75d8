"""Events of a motion model that was switched."""

from engine.core.learning_status import LearningEvent, LearningEventKind

SWAPPED = LearningEvent(
    kind=LearningEventKind.SWAPPED,
    detail="a model took over",
    timestamp_us=1_000,
    figures={"correction_mm": 0.02, "zero_before_mm": 850.01, "zero_after_mm": 850.03},
)
