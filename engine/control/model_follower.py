"""Follows the learner for the gate: a changed model disarms, and a window in per cent becomes one in mm."""

from engine.control.roles import Learner
from engine.control.session_limits import SessionLimits


class ModelFollower:
    """Remembers with which model the gate was armed, and for which reference the window was resolved."""

    def __init__(self, learner: Learner, limits: SessionLimits) -> None:
        self._learner, self._limits = learner, limits
        self._generation = learner.status.model_generation
        self._resolved_for: int | None = None

    def has_changed(self) -> bool:
        """Whether the model or the reference has changed since the last call."""
        before, self._generation = self._generation, self._learner.status.model_generation
        return before != self._generation

    def resolve_window(self) -> None:
        """Resolve a window in per cent into mm, once for each reference that is set.

        Another model with the same reference has another learned range, of where the patient lies now: a window that
        took it over would follow a drift that no person has confirmed.
        """
        reference = self._learner.status.reference_number
        if self._resolved_for == reference or not self._limits.prescribed_window.needs_ranges:
            return
        ranges = self._learner.learned_ranges(self._limits.prescribed_window.choices)
        self._limits.resolve_window(ranges)
        if ranges:
            self._resolved_for = reference

    def resolve_again(self) -> None:
        """Resolve another window with the next frame: by then a range may be known."""
        self._resolved_for = None
