"""The predicted duty cycle of the window in use, computed again when the model, the reference or the window changes."""

from engine.control.roles import Learner
from engine.control.session_limits import SessionLimits
from engine.gating.duty_cycle import duty_percent, refuse_never_left


class DutyForecast:
    """How much of the learned breaths lies in the window; owned by the engine thread."""

    def __init__(self, learner: Learner, limits: SessionLimits) -> None:
        self._learner, self._limits = learner, limits
        self._made_for: tuple[object, ...] | None = None
        self._percent: float | None = None

    @property
    def percent(self) -> float | None:
        """The predicted duty cycle, 0 to 100; None where it is not known, and for breath holds."""
        status, window = self._learner.status, self._limits.current.window
        present = (status.model_generation, status.reference_number, status.has_reference, window)
        if present != self._made_for:
            self._made_for = present
            self._percent = duty_percent(window, self._learner.learned_levels(window.choices))
        return self._percent

    def refuse_never_left(self) -> None:
        """Raise InvalidValueError where the window holds more than the site allows; CommandRefusedError if unknown."""
        limits = self._limits.current
        refuse_never_left(limits, self._learner.learned_levels(limits.window.choices))
