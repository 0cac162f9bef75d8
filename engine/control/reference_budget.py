"""The budget that references, baseline corrections and windows of a fraction share, measured from its first ones.

Beyond it a person who may arm has to give a reason. What was moved in many small steps counts in full, because no step
is measured from the one before. A window counts from the first one that was armed, by how far it reaches beyond that
one; in a fraction that another session has begun, from the one that the session begins with. A person's reason makes
the next window that is armed the first one.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

from engine.control.roles import Learner
from engine.control.session_limits import SessionLimits
from engine.core.breath import SignalChoice
from engine.core.commands import Arm, CorrectBaseline, SetReference
from engine.core.errors import ReferenceDistanceError
from engine.core.reference import ReferenceDistance, SignalLevel
from engine.gating.active_window import SetWindow, window_text
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, GateWindow, PhaseWindow, Unit

# How far a window reaches beyond another one, in mm of the patient: its edges, with the reference they count from.


class _Edges(NamedTuple):
    """Edges of a condition against the fraction's first reference, in mm; of a phase in per cent of the breath."""

    lower: float
    upper: float
    is_phase: bool


PlacedWindow = tuple[_Edges, ...]
"""The edges of a window's conditions, in their order."""


def placed_window(window: GateWindow, reference: ReferenceDistance | None) -> PlacedWindow | None:
    """Return where a window's edges lie against the fraction's first reference; None while any is in per cent.

    Parameters
    ----------
    reference
        That of the window, without its correction; None for the first one itself. A level that is not known counts as
        that of the first: a reference at an unknown distance has a person's reason of its own.
    """
    levels = {} if reference is None else {one.choice: one.level for one in reference.levels}
    placed = [_placed(leaf, levels) for leaf in window.leaves]
    return None if None in placed else tuple(one for one in placed if one is not None)


def _placed(
    leaf: AmplitudeWindow | BreathHoldWindow | PhaseWindow, levels: Mapping[SignalChoice, float]
) -> _Edges | None:
    if isinstance(leaf, PhaseWindow):
        return _Edges(leaf.from_percent, leaf.to_percent, is_phase=True)
    edges = leaf.level if isinstance(leaf, BreathHoldWindow) else leaf
    if edges.unit is Unit.PERCENT:
        return None
    known, per_mm = levels.get(edges.choice, 0.0), edges.choice.per_mm
    level = known if math.isfinite(known) else 0.0
    return _Edges((edges.lower + level) / per_mm, (edges.upper + level) / per_mm, is_phase=False)


def reach_beyond_mm(before: PlacedWindow, now: PlacedWindow) -> float:
    """Return how far ``now`` reaches beyond ``before`` [mm], of both of the same conditions; 0 where it lies inside.

    Infinite for a phase that reaches beyond the earlier one.
    """
    return max(0.0, *(_beyond(*pair) for pair in zip(before, now, strict=True)))


def _beyond(before: _Edges, now: _Edges) -> float:
    if now.is_phase:
        width, offset = _arc(before.lower, before.upper), _arc(before.lower, now.lower)
        return 0.0 if offset + _arc(now.lower, now.upper) <= width else math.inf
    return max(before.lower - now.lower, now.upper - before.upper)


def _arc(start: float, end: float) -> float:
    """Return the way from one phase to another [%], onwards."""
    return (end - start) % 100.0


MAX_ROUNDING_MM = 1e-6
NO_REASON = "beyond it a person who may arm has to give a reason"
NOT_ALLOWED = "beyond it only a person who may arm can go, with a reason"


class ReferenceBudget:
    """Compares what operators ask for with the budget; owned by the engine thread."""

    def __init__(self, learner: Learner, limits: SessionLimits) -> None:
        self._learner, self._limits = learner, limits
        self._begun_with = placed_window(limits.current.window, None)
        self._armed_first: PlacedWindow | None = None
        self._has_reason = False

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
            self._has_reason = True
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
        corrected = self._limits.corrected(command.by)
        if not self._may_exceed(command):
            self._refuse_beyond("by", self._now().corrected(command.by), command)
            self._refuse_reach("by", corrected.window, command)
        self._has_reason = self._may_exceed(command)

    def check_window(self, window: GateWindow, command: SetWindow) -> None:
        """Refuse a window that reaches further beyond the fraction's first than the budget; per cent at its arming.

        Raises
        ------
        ReferenceDistanceError
            Beyond the budget, without a person's reason.
        """
        if not self._may_exceed(command):
            self._refuse_reach("window", window, command)
        self._has_reason = self._may_exceed(command)

    def check_arming(self, command: Arm) -> None:
        """Refuse to arm a window beyond the budget, as references, corrections and per cent have made it.

        Raises
        ------
        ReferenceDistanceError
            Beyond the budget, without a person's reason, given now or with what led to it.
        """
        if not self._has_reason and not (command.is_person and command.reason.strip()):
            self._refuse_reach("window", self._limits.current.window, command)

    @property
    def is_reason_needed(self) -> bool:
        """Whether the present window is armed with a person's reason only."""
        reach_mm = self._reach_mm(self._limits.current.window)
        return not self._has_reason and not self._is_within(reach_mm)

    @property
    def is_first_arming(self) -> bool:
        """Whether the next arming is the fraction's first, or makes its window the first one, with a reason."""
        return self._first is None or not self._is_within(self._reach_mm(self._limits.current.window))

    def note_armed(self) -> None:
        """Count from the window that was armed: the fraction's first, or one for which a person gave a reason."""
        if self.is_first_arming:
            self._armed_first = placed_window(self._limits.current.window, self._learner.status.reference_distance)
        self._has_reason = False

    def _now(self) -> ReferenceDistance:
        """Return the present distance; that of the correction alone before a reference is set."""
        nowhere = SignalLevel(self._limits.prescribed_window.choices[0], 0.0)
        return self.present() or ReferenceDistance(moved_mm=0.0, levels=(nowhere,), correction=self._limits.correction)

    def _refuse_beyond(self, field: str, distance: ReferenceDistance, command: SetReference | CorrectBaseline) -> None:
        budget_mm = self._limits.current.max_reference_distance_mm
        if not distance.is_within(budget_mm):
            advice = NO_REASON if command.may_exceed else NOT_ALLOWED
            raise ReferenceDistanceError(field, distance.text, f"within {budget_mm:g} mm of it", advice)

    def _refuse_reach(self, field: str, window: GateWindow, command: SetWindow | CorrectBaseline | Arm) -> None:
        reach_mm, budget_mm = self._reach_mm(window), self._limits.current.max_reference_distance_mm
        if self._is_within(reach_mm):
            return
        may_exceed = command.is_person if isinstance(command, Arm) else command.may_exceed
        how_far = f"{reach_mm:.2f} mm" if math.isfinite(reach_mm) else "phases"
        value = f"{window_text(window)}, {how_far} beyond the fraction's first"
        advice = NO_REASON if may_exceed else NOT_ALLOWED
        raise ReferenceDistanceError(field, value, f"within {budget_mm:g} mm of it", advice)

    @property
    def _first(self) -> PlacedWindow | None:
        """The fraction's first window; None where none was armed yet, or it is in per cent."""
        is_continued = self._armed_first is None and self._learner.status.is_fraction_continued
        return self._begun_with if is_continued else self._armed_first

    def _reach_mm(self, window: GateWindow) -> float:
        """Return how far a window reaches beyond the fraction's first [mm]; 0 for none, and while it is in per cent."""
        placed = placed_window(window, self._learner.status.reference_distance)
        first = self._first
        return 0.0 if first is None or placed is None else reach_beyond_mm(first, placed)

    def _is_within(self, reach_mm: float) -> bool:
        return reach_mm <= self._limits.current.max_reference_distance_mm + MAX_ROUNDING_MM

    @staticmethod
    def _may_exceed(command: SetReference | CorrectBaseline | SetWindow) -> bool:
        return command.may_exceed and bool(command.reason.strip())
