"""What frames are gathered for: a new model, a known model's turn, or a look at the patient with a stored one.

Each errand takes frames in the engine thread until it has enough, and then makes a job for the trainer's thread. The
job knows only what it was given, so it may run anywhere and at any time.
"""

from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from typing import Protocol

import numpy as np

from engine.active_model import ActiveModel
from engine.carry import Carry, Explain, compare_models, recent
from engine.errors import TrainingRefusedError
from engine.fitting import fit
from engine.frames import Projection, TrainingProgress
from engine.gathering import MAX_GAP_S, GatheredFrame, TrainingSet, Vertices, evenly, mean_surface
from engine.likeness import Likeness, LikenessLimits, compare_with_patient
from engine.model import MotionModel
from engine.notices import Figures
from engine.provenance import Provenance, TrainingQuality
from engine.quality import find_outliers, refuse_breathless, refuse_disturbed, refuse_moving
from engine.training import TrainingSettings

QUALITY_FRAMES = 60
SURFACE_FRAMES = 120
HANDOVER_SECONDS = 2.0
HANDOVER_FRAMES = 30
LOOK_FRAMES = 60
MIN_LOOK_FRAMES = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningStages:
    """What of the measuring a job needs; each is a pure function, called wherever the trainer runs.

    Attributes
    ----------
    prepare
        Works everything out that frames will need of a model.
    explain
        Explains a region with a prepared model; None where it does not well enough.
    vertices
        Finds the points of the surface at the nodes.
    """

    prepare: Callable[[MotionModel], ActiveModel]
    explain: Explain
    vertices: Vertices


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A model made ready to take over.

    Attributes
    ----------
    before
        The model it was compared with, and may take over from; None for a first one.
    carry
        How the zero is carried over; None where there is none to carry, or where it must not be.
    needs_zero
        Whether a person has to set the zero before anybody arms.
    is_stored
        Whether it comes from an earlier fraction, and has to be compared with the patient of today.
    """

    active: ActiveModel
    before: ActiveModel | None = None
    carry: Carry | None = None
    needs_zero: bool = False
    is_stored: bool = False


Outcome = Candidate | Likeness


class Errand(Protocol):
    """Frames being gathered for something."""

    def add(self, frame: GatheredFrame) -> None:
        """Take a frame."""

    @property
    def is_complete(self) -> bool:
        """Whether there are enough."""

    @property
    def needs_measured(self) -> bool:
        """Whether only frames count that the present model measures."""

    @property
    def progress(self) -> TrainingProgress:
        """How far it has come."""

    def job(self, before: ActiveModel | None) -> Callable[[], Outcome]:
        """Return what is to be done with the frames; ``before`` is the model measured with now."""


class Learning:
    """Gathers a training set and has a model fitted.

    Parameters
    ----------
    keeps_zero
        Whether the zero is carried over from the model before; otherwise a person has to set it again.
    """

    def __init__(
        self, settings: TrainingSettings, stages: LearningStages, calibration_sha256: str, *, keeps_zero: bool = True
    ) -> None:
        self._settings, self._stages = settings, stages
        self._calibration_sha256 = calibration_sha256
        self._keeps_zero = keeps_zero
        self._set = TrainingSet(settings, stages.vertices)

    def add(self, frame: GatheredFrame) -> None:
        """Take a frame."""
        self._set.add(frame)

    @property
    def is_complete(self) -> bool:
        """Whether it is time to fit."""
        return self._set.is_complete

    @property
    def needs_measured(self) -> bool:
        """Whether only measured frames count: what lies on the patient must not be learned behind the zero's back."""
        return self._keeps_zero

    @property
    def progress(self) -> TrainingProgress:
        """How far the gathering has come."""
        return self._set.progress

    def job(self, before: ActiveModel | None) -> Callable[[], Outcome]:
        """Return the judging and the fit of these frames as a function."""
        gathered, stages, settings = self._set, self._stages, self._settings
        keeps_zero = self._keeps_zero

        def run() -> Candidate:
            active, frames = _learned(gathered, stages, settings, self._calibration_sha256)
            carry = None
            if before is not None and keeps_zero:
                carry = _carry(before, active, recent(frames), stages, settings.max_carry_mm)
            return Candidate(
                active=active, before=before, carry=carry, needs_zero=before is not None and not keeps_zero
            )

        return run


class Handover:
    """Gathers a moment's frames, to carry the zero over to a model that is there already."""

    def __init__(self, model: MotionModel, settings: TrainingSettings, stages: LearningStages) -> None:
        self._model, self._settings, self._stages = model, settings, stages
        self._frames: list[GatheredFrame] = []

    def add(self, frame: GatheredFrame) -> None:
        """Take a frame."""
        _drop_before_gap(self._frames, frame)
        self._frames.append(frame)

    @property
    def is_complete(self) -> bool:
        """Whether two seconds are there."""
        return len(self._frames) >= HANDOVER_FRAMES and _seconds(self._frames) >= HANDOVER_SECONDS

    @property
    def needs_measured(self) -> bool:
        """Whether only measured frames count: the present model has to explain them."""
        return True

    @property
    def progress(self) -> TrainingProgress:
        """How far the gathering has come."""
        return _look_progress(self._frames, HANDOVER_SECONDS, "carrying the zero over to another model")

    def job(self, before: ActiveModel | None) -> Callable[[], Outcome]:
        """Return the preparing and the comparison with the present model as a function."""
        frames, stages, model = recent(self._frames), self._stages, self._model
        most_mm = self._settings.max_carry_mm

        def run() -> Candidate:
            active = stages.prepare(model)
            carry = None if before is None else _carry(before, active, frames, stages, most_mm)
            return Candidate(active=active, before=before, carry=carry)

        return run


class Look:
    """Gathers frames to compare a stored model with the patient of today; that model is measured with meanwhile."""

    def __init__(self, active: ActiveModel, limits: LikenessLimits, stages: LearningStages) -> None:
        self._active, self._limits, self._stages = active, limits, stages
        self._frames: list[GatheredFrame] = []

    def add(self, frame: GatheredFrame) -> None:
        """Take a frame, if it is not too soon after the one before."""
        _drop_before_gap(self._frames, frame)
        step_us = self._limits.seconds * 1e6 / LOOK_FRAMES
        if not self._frames or frame.timestamp_us - self._frames[-1].timestamp_us >= step_us:
            self._frames.append(frame)

    @property
    def is_complete(self) -> bool:
        """Whether the patient was looked at for long enough."""
        return len(self._frames) >= MIN_LOOK_FRAMES and _seconds(self._frames) >= self._limits.seconds

    @property
    def needs_measured(self) -> bool:
        """Whether only measured frames count: here those count most that are not."""
        return False

    @property
    def progress(self) -> TrainingProgress:
        """How far the look has come."""
        return _look_progress(self._frames, self._limits.seconds, "comparing the stored model with the patient")

    def job(self, before: ActiveModel | None) -> Callable[[], Outcome]:
        """Return the comparison as a function; the model before is the stored one itself."""
        frames, limits, stages = list(self._frames), self._limits, self._stages
        active = before or self._active
        return lambda: compare_with_patient(active, frames, limits, explain=stages.explain, vertices=stages.vertices)


def _learned(
    gathered: TrainingSet, stages: LearningStages, settings: TrainingSettings, calibration_sha256: str
) -> tuple[ActiveModel, list[GatheredFrame]]:
    frames, signals = gathered.frames, gathered.signals
    amplitude_mm, noise_mm = refuse_breathless(signals, settings)
    shift_mm, tilt_deg = refuse_moving(frames, stages.vertices, settings, amplitude_mm)
    outliers = find_outliers(frames, signals, amplitude_mm)
    outlier_share = refuse_disturbed(outliers, settings)
    kept = [frame for frame, is_outlier in zip(frames, outliers, strict=True) if not is_outlier]
    model = _fitted(kept, gathered, settings, calibration_sha256)
    model = replace(model, surface_mm=mean_surface(evenly(kept, SURFACE_FRAMES), stages.vertices))
    active = stages.prepare(model)
    explained = _explained(active, evenly(kept, QUALITY_FRAMES), stages)
    quality = TrainingQuality(
        amplitude_mm=amplitude_mm,
        noise_mm=noise_mm,
        explained_share=min(float(model.spectrum[: len(model.components)].sum()), 1.0),
        shift_mm=shift_mm,
        tilt_deg=tilt_deg,
        outlier_share=outlier_share,
        residual_mm=float(np.median([outcome.residual_mm for outcome in explained])),
    )
    settled = {field.name: float(getattr(settings, field.name)) for field in fields(settings)}
    scores_mm = np.stack([outcome.beta for outcome in explained]).astype(np.float32)
    model = replace(model, scores_mm=scores_mm, provenance=Provenance(quality=quality, settings=settled))
    return replace(active, model=model), kept


def _fitted(
    kept: list[GatheredFrame], gathered: TrainingSet, settings: TrainingSettings, calibration_sha256: str
) -> MotionModel:
    return fit(
        np.stack([frame.roi.depth_mm for frame in kept]),
        np.stack([frame.roi.valid for frame in kept]),
        components=settings.components,
        cycles=gathered.cycles,
        seconds=gathered.seconds,
        calibration_sha256=calibration_sha256,
    )


def _carry(
    before: ActiveModel, active: ActiveModel, frames: list[GatheredFrame], stages: LearningStages, most_mm: float
) -> Carry:
    carry = compare_models(before, active, frames, explain=stages.explain, vertices=stages.vertices)
    if not carry.correction_mm <= most_mm:
        raise TrainingRefusedError(
            "carry.correction_mm",
            f"{carry.correction_mm:.2f}",
            f"at most {most_mm:g}",
            "the two models do not agree on where the patient is: the camera or the patient has moved; learn again "
            "without keeping the zero, then set it",
        )
    return carry


def _explained(active: ActiveModel, frames: list[GatheredFrame], stages: LearningStages) -> list[Projection]:
    """Explain training frames with the model learned from them."""
    outcomes = [stages.explain(active, frame.roi, None) for frame in frames]
    explained = [outcome for outcome in outcomes if outcome is not None]
    if not explained:
        raise TrainingRefusedError(
            "training.explained", "no frame", "explained by its own model", "clear the view of the camera"
        )
    return explained


def _drop_before_gap(frames: list[GatheredFrame], frame: GatheredFrame) -> None:
    """Begin anew after a gap, or when the device's clock went back: the patient may lie otherwise."""
    if frames and not 0.0 < (frame.timestamp_us - frames[-1].timestamp_us) / 1e6 <= MAX_GAP_S:
        frames.clear()


def _seconds(frames: list[GatheredFrame]) -> float:
    return (frames[-1].timestamp_us - frames[0].timestamp_us) / 1e6 if frames else 0.0


def _look_progress(frames: list[GatheredFrame], wanted_s: float, note: str) -> TrainingProgress:
    seconds = _seconds(frames)
    return TrainingProgress(
        frames=len(frames), cycles=0, seconds=seconds, share=min(max(seconds / wanted_s, 0.0), 1.0), note=note
    )


def quality_figures(model: MotionModel) -> Figures:
    """Put what a model says of its training into figures for a notice."""
    quality = model.provenance.quality
    told = {} if quality is None else {name: round(value, 4) for name, value in asdict(quality).items()}
    return {"frames": model.training_frames, "cycles": model.cycles, **told}
