"""What the parts of the learning share: device time, events, the newest refusal, numbers of changes.

Figures of learning events.
"""

import math

from engine.core.learning_status import Figures, LearningEvent, LearningEventKind, PatientMatch
from engine.core.position_check import PositionCheck
from engine.core.reference import FirstReference, ReferenceDistance
from engine.motion.learning.prepared_model import Reference
from engine.motion.learning.tasks import Candidate, quality_figures

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


def transfer_figures(candidate: Candidate, previous_reference: Reference | None) -> Figures:
    """Return the quality of a new model, and how far the reference was corrected for it [mm; l]."""
    figures = dict(quality_figures(candidate.active.model))
    transfer = candidate.transfer
    if transfer is not None:
        figures |= {"correction_mm": round(transfer.correction_mm, 4), "carry_frames": transfer.frames}
        figures |= {"volume_correction_l": round(transfer.volume_l, 6)}
        if previous_reference is not None:
            reference_mm = float(previous_reference.regions_mm[candidate.active.regions.cells])
            figures |= {
                "zero_before_mm": round(reference_mm, 4),
                "zero_after_mm": round(reference_mm + transfer.whole_mm, 4),
            }
    return figures


def match_figures(patient_match: PatientMatch) -> Figures:
    """Return how far the patient is from a stored model."""
    return {
        "frames": patient_match.frames,
        "explained_share": round(patient_match.explained_share, 3),
        "residual_mm": None if patient_match.residual_mm is None else round(patient_match.residual_mm, 3),
        **{f"shift_{axis}_mm": round(value, 2) for axis, value in zip("xyz", patient_match.shift_mm, strict=True)},
        "tilt_deg": round(patient_match.tilt_deg, 3),
        "shape_mm": round(patient_match.shape_mm, 3),
        "is_accepted": patient_match.refusal is None,
    }


def distance_figures(distance: ReferenceDistance) -> Figures:
    """Return how far a reference lies from the fraction's first; None where that is not known."""
    names = ("shift_mm", "height_mm", "turn_deg", "tilt_deg", "shape_mm", "uncertainty_mm")
    levels = {f"level_{one.choice.label}_{one.choice.unit}": _known(one.level) for one in distance.levels}
    total_mm = distance.distance_mm
    return {
        "distance_mm": None if total_mm is None else round(total_mm, 3),
        **{name: _known(getattr(distance, name)) for name in names},
        **levels,
        "unknown": distance.unknown or None,
    }


def position_figures(check: PositionCheck | None) -> Figures:
    """Return where a reference lies against the plan's position; empty without one."""
    if check is None:
        return {}
    degrees = {f"position_{one.name}_{one.unit}": _known(one.value) for one in check.degrees}
    uncertainties = {f"position_{one.name}_uncertainty_{one.unit}": _known(one.uncertainty) for one in check.degrees}
    shape = {"position_shape_mm": _known(check.shape_mm), "position_unknown": check.unknown or None}
    return {**degrees, **uncertainties, **shape}


def _known(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None
