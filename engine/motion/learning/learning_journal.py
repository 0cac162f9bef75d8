"""What the parts of the learning share: device time, events, the newest refusal, numbers of changes."""

from engine.core.first_reference import FirstReference
from engine.core.learning_events import Figures, LearningEvent, LearningEventKind

REFUSAL_SHOWN_S = 30.0
"""How long a refusal is shown while the previous model is in use [s]."""


class LearningJournal:
    """Collects events for the audit; owned by the pipeline's thread.

    Attributes
    ----------
    now_us
        Device time of the newest frame [us].
    generation
        Changes with every change of model or reference, which disarms the gate.
    position_generation
        Changes with every change except that to a model which takes the reference over.
    refusal
        The newest refusal until another training begins or succeeds; empty without one.
    """

    def __init__(self) -> None:
        self.now_us = 0
        self.generation = 0
        self.position_generation = 0
        self.refusal = ""
        self._refused_us = 0
        self._events: list[LearningEvent] = []

    def emit(
        self, kind: LearningEventKind, detail: str, figures: Figures | None = None, first: FirstReference | None = None
    ) -> None:
        """Add an event."""
        self._events.append(
            LearningEvent(kind=kind, detail=detail, timestamp_us=self.now_us, figures=figures or {}, first=first)
        )

    def take(self) -> list[LearningEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def change(self, *, is_position_new: bool = True) -> None:
        """Count a change of model or reference; the position is the same where the reference was transferred."""
        self.generation += 1
        if is_position_new:
            self.position_generation += 1

    def refuse(self, detail: str, figures: Figures) -> None:
        """Add a refusal, which is shown for a while."""
        self.emit(LearningEventKind.REFUSED, detail, figures)
        self.refusal, self._refused_us = detail, self.now_us

    @property
    def recent_refusal(self) -> str:
        """The newest refusal, for `REFUSAL_SHOWN_S`; empty without one."""
        return self.refusal if self.now_us - self._refused_us <= REFUSAL_SHOWN_S * 1e6 else ""
