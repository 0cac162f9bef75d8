"""What an arming would take now, and whose word it needs: shown to the person, and compared when the gate is armed."""

import hashlib

from engine.control.countersignature import Countersignature, CountersignatureState
from engine.control.duty_forecast import DutyForecast
from engine.control.reference_budget import ReferenceBudget
from engine.control.roles import Learner
from engine.control.session_limits import SessionLimits
from engine.gating.windows import GateWindow, Join, JoinedWindow


class ArmingOutlook:
    """Owned by the engine thread.

    Attributes
    ----------
    countersignature
        The second person's, for the present `state`.
    forecast
        Share of the learned breaths inside the window.
    """

    def __init__(self, learner: Learner, limits: SessionLimits, budget: ReferenceBudget) -> None:
        self._learner, self._limits, self._budget = learner, limits, budget
        self.countersignature = Countersignature(budget, limits)
        self.forecast = DutyForecast(learner, limits)
        self._hashed: tuple[object, ...] = ()
        self._hash = ""

    @property
    def state(self) -> str:
        """Hash of what an arming would take; the same only for the same window, reference, model and head direction."""
        learning, limits = self._learner.status, self._limits.current
        present = (
            limits.window,
            (limits.dwell_ms, limits.min_on_ms, limits.min_off_ms, limits.max_cycles_per_min),
            limits.head_direction,
            learning.reference_number,
            learning.model_generation,
        )
        if present != self._hashed:
            self._hashed, self._hash = present, hashlib.sha256(repr(present).encode()).hexdigest()[:32]
        return self._hash

    @property
    def has_ways(self) -> bool:
        """Whether any one of several conditions permits the beam."""
        return _has_ways(self._limits.current.window)

    @property
    def is_reason_needed(self) -> bool:
        """Whether the window is armed by a person with a reason only: joined by or, or beyond the fraction's budget."""
        return self.has_ways or self._budget.is_reason_needed

    @property
    def signed(self) -> CountersignatureState:
        """Whether the next arming needs a second person's countersignature, and who has given it."""
        return self.countersignature.present(self.state)


def _has_ways(window: GateWindow) -> bool:
    return isinstance(window, JoinedWindow) and window.join is Join.OR
