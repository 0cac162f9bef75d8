"""The learned breaths against the window in use, computed again when the model, the reference or the window changes."""

from engine.control.roles import Learner
from engine.control.session_limits import SessionLimits
from engine.core.ranges import Ranges, ranges_of
from engine.gating.duty_cycle import duty_percent, refuse_hold_in_free_breath, refuse_never_left


class DutyForecast:
    """How much of the learned breaths lies in the window, and their range; owned by the engine thread."""

    def __init__(self, learner: Learner, limits: SessionLimits) -> None:
        self._learner, self._limits = learner, limits
        self._made_for: tuple[object, ...] | None = None
        self._percent: float | None = None
        self._ranges: Ranges = {}

    @property
    def percent(self) -> float | None:
        """The predicted duty cycle, 0 to 100; None where it is not known, and for breath holds."""
        self._make()
        return self._percent

    @property
    def ranges(self) -> Ranges:
        """The learned range of each signal of the window; signals whose range is not known are absent."""
        self._make()
        return self._ranges

    def _make(self) -> None:
        status, window = self._learner.status, self._limits.current.window
        present = (status.model_generation, status.reference_number, status.has_reference, window)
        if present != self._made_for:
            self._made_for = present
            levels = self._learner.learned_levels(window.choices)
            self._percent, self._ranges = duty_percent(window, levels), ranges_of(levels)

    def refuse_free_breath(self) -> None:
        """Refuse a window that the learned breaths never leave, or a breath hold that they reach.

        Raises
        ------
        InvalidValueError
            More of the learned breaths lie inside than the site allows, or a hold lies where the patient breathes.
        CommandRefusedError
            The learned breaths are not known.
        """
        limits = self._limits.current
        levels = self._learner.learned_levels(limits.window.choices)
        refuse_never_left(limits, levels)
        refuse_hold_in_free_breath(limits, levels)
