"""The budget that references and baseline corrections of a fraction share, measured from its first reference.

Beyond it a person who may arm has to give a reason. What was moved in many small steps counts in full, because no step
is measured from the one before.
"""

from engine.control.roles import Learner
from engine.control.session_limits import SessionLimits
from engine.core.commands import CorrectBaseline, SetReference
from engine.core.errors import ReferenceDistanceError
from engine.core.reference_distance import ReferenceDistance, SignalLevel

NO_REASON = "beyond it a person who may arm has to give a reason"
NOT_ALLOWED = "beyond it only a person who may arm can go, with a reason"


class ReferenceBudget:
    """Compares what operators ask for with the budget; owned by the engine thread."""

    def __init__(self, learner: Learner, limits: SessionLimits) -> None:
        self._learner, self._limits = learner, limits

    def present(self) -> ReferenceDistance | None:
        """Return how far reference and window lie from the fraction's first reference; None without a reference."""
        distance = self._learner.status.reference_distance
        return None if distance is None else distance.corrected(self._limits.correction)

    def checked_mm(self, command: SetReference) -> float | None:
        """Return the largest distance [mm] that the reference may have when it is taken up, None for any.

        Raises
        ------
        ReferenceDistanceError
            The position lies beyond the budget, or its distance is not known, without a person's reason.
        """
        distance = self._learner.reference_distance(command.moment)
        if self._may_exceed(command):
            return None
        if distance is not None:
            self._refuse_beyond("reference", distance, command)
        return self._limits.current.max_reference_distance_mm

    def check_correction(self, command: CorrectBaseline) -> None:
        """Refuse a correction that the window cannot have, or by which it lies beyond the budget.

        Raises
        ------
        InvalidValueError
            Beyond the site's limit of corrections.
        ReferenceDistanceError
            Beyond the budget, without a person's reason.
        """
        self._limits.corrected(command.by)
        if not self._may_exceed(command):
            self._refuse_beyond("by", self._now().corrected(command.by), command)

    def _now(self) -> ReferenceDistance:
        """Return the present distance; that of the correction alone before a reference is set."""
        nowhere = SignalLevel(self._limits.prescribed_window.choices[0], 0.0)
        return self.present() or ReferenceDistance(moved_mm=0.0, levels=(nowhere,), correction=self._limits.correction)

    def _refuse_beyond(self, field: str, distance: ReferenceDistance, command: SetReference | CorrectBaseline) -> None:
        budget_mm = self._limits.current.max_reference_distance_mm
        if not distance.is_within(budget_mm):
            advice = NO_REASON if command.may_exceed else NOT_ALLOWED
            raise ReferenceDistanceError(field, distance.text, f"within {budget_mm:g} mm of it", advice)

    @staticmethod
    def _may_exceed(command: SetReference | CorrectBaseline) -> bool:
        return command.may_exceed and bool(command.reason.strip())
