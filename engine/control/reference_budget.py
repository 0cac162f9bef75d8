"""The budget that references, baseline corrections and windows of a fraction share, measured from its first ones.

Beyond it a person who may arm has to give a reason. What was moved in many small steps counts in full, because no step
is measured from the one before. A window counts from the first one that was armed in the fraction, in whichever
session, by how far it reaches beyond that one. A person's reason makes the next window that is armed the first one.

A second person's signature belongs to the window that was armed with it: it lasts, over the sessions of the fraction,
while no window is set beyond that one and the reference is known to be within the budget (ADR 0055).
"""

import math
from collections.abc import Mapping
from dataclasses import replace

from engine.control.roles import Learner
from engine.control.session_limits import SessionLimits
from engine.core.breath import SignalChoice
from engine.core.commands import Arm, CorrectBaseline, SetReference
from engine.core.errors import ReferenceDistanceError
from engine.core.fraction_arming import (
    MAX_ROUNDING,
    PHASE,
    FractionArming,
    PlacedCondition,
    PlacedWindow,
    is_set_beyond,
    reach_beyond,
)
from engine.core.reference import ReferenceDistance, SignalLevel
from engine.gating.active_window import SetWindow, window_text
from engine.gating.windows import AmplitudeWindow, BreathHoldWindow, GateWindow, JoinedWindow, PhaseWindow, Unit

NO_REASON = "beyond it a person who may arm has to give a reason"
NOT_ALLOWED = "beyond it only a person who may arm can go, with a reason"


def placed_window(
    window: GateWindow, reference: ReferenceDistance | None, as_set: GateWindow | None = None
) -> PlacedWindow | None:
    """Return where a window's edges lie against the fraction's first reference; None while any is in per cent.

    Parameters
    ----------
    reference
        That of the window, without its correction; None for the first one itself. A level that is not known counts as
        that of the first: a reference at an unknown distance has a person's reason of its own.
    as_set
        The window as it was prescribed; by default the same.
    """
    levels = {} if reference is None else {one.choice: one.level for one in reference.levels}
    join = window.join if isinstance(window, JoinedWindow) else ""
    leaves = zip(window.leaves, (as_set or window).leaves, strict=True)
    placed = [_placed(leaf, set_leaf, levels, join) for leaf, set_leaf in leaves]
    return None if None in placed else tuple(one for one in placed if one is not None)


def _placed(
    leaf: AmplitudeWindow | BreathHoldWindow | PhaseWindow,
    as_set: AmplitudeWindow | BreathHoldWindow | PhaseWindow,
    levels: Mapping[SignalChoice, float],
    join: str,
) -> PlacedCondition | None:
    hold = leaf.kind if isinstance(leaf, BreathHoldWindow) else ""
    kind = " ".join(filter(None, (join, type(leaf).__name__, hold, leaf.choices[0].label)))
    if isinstance(leaf, PhaseWindow):
        phases = (leaf.from_percent, leaf.to_percent)
        return PlacedCondition(kind, *phases, *phases, PHASE)
    edges = leaf.level if isinstance(leaf, BreathHoldWindow) else leaf
    set_edges = as_set.level if isinstance(as_set, BreathHoldWindow) else as_set
    if edges.unit is Unit.PERCENT or isinstance(set_edges, PhaseWindow):
        return None
    known, per_mm = levels.get(edges.choice, 0.0), edges.choice.per_mm
    level = known if math.isfinite(known) else 0.0
    lower, upper = ((edge + level) / per_mm for edge in (edges.lower, edges.upper))
    return PlacedCondition(kind, lower, upper, set_edges.lower, set_edges.upper, str(set_edges.unit))


class ReferenceBudget:
    """Compares what operators ask for with the budget; owned by the engine thread.

    Attributes
    ----------
    arming
        What the fraction was armed with, by this session or an earlier one; None where it was not.
    """

    def __init__(self, learner: Learner, limits: SessionLimits, arming: FractionArming | None = None) -> None:
        self._learner, self._limits = learner, limits
        self._has_reason = False
        self.arming = arming

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
    def is_unsigned(self) -> bool:
        """Whether no second person's signature covers the next arming.

        None was armed with in this fraction; or the window is set beyond the one that was, or lies beyond it by more
        than the budget with its reference and correction; or the distance of the reference is not known.
        """
        signed = None if self.arming is None else self.arming.signed
        placed = self._placed_now()
        if signed is None or placed is None:
            return True
        distance = self.present()
        is_known = distance is None or distance.distance_mm is not None
        return not is_known or is_set_beyond(signed, placed) or not self._is_within(reach_beyond(signed, placed))

    def note_armed(self, operator: str, signed_by: str | None) -> None:
        """Count from the window that was armed: the fraction's first, or one for which a person gave a reason.

        ``signed_by`` is the second person whose signature this arming needed; None where it needed none.
        """
        self._has_reason = False
        placed = self._placed_now()
        if placed is None:
            return
        if self.arming is None or not self._is_within(reach_beyond(self.arming.first, placed)):
            kept = FractionArming(first=placed, armed_by=operator)
            if self.arming is not None:
                kept = replace(self.arming, first=placed, armed_by=operator)
            self.arming = kept
        if signed_by is not None:
            self.arming = replace(self.arming, signed=placed, signed_by=signed_by, signed_for=operator)

    def _placed_now(self) -> PlacedWindow | None:
        """Return where the window in use lies; None while any of its edges is in per cent."""
        return placed_window(
            self._limits.current.window, self._learner.status.reference_distance, self._limits.prescribed_window
        )

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
        how_far = f"{reach_mm:.2f} mm" if math.isfinite(reach_mm) else "phases or conditions"
        value = f"{window_text(window)}, {how_far} beyond the fraction's first"
        advice = NO_REASON if may_exceed else NOT_ALLOWED
        raise ReferenceDistanceError(field, value, f"within {budget_mm:g} mm of it", advice)

    def _reach_mm(self, window: GateWindow) -> float:
        """Return how far a window reaches beyond the fraction's first [mm]; 0 for none, and while it is in per cent."""
        placed = placed_window(window, self._learner.status.reference_distance)
        return 0.0 if self.arming is None or placed is None else reach_beyond(self.arming.first, placed)

    def _is_within(self, reach_mm: float) -> bool:
        return reach_mm <= self._limits.current.max_reference_distance_mm + MAX_ROUNDING

    @staticmethod
    def _may_exceed(command: SetReference | CorrectBaseline | SetWindow) -> bool:
        return command.may_exceed and bool(command.reason.strip())
