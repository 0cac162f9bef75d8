"""Learning tasks: fit a new model, switch to a stored model, compare a stored model with the patient.

A task collects frames in the engine thread until it is complete, and then gives a job to the trainer. The job is a
value: it depends only on its inputs, so it can run in any thread or process at any time.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Protocol

import numpy as np

from engine.core.errors import TrainingRefusedError
from engine.core.frames import Projection, RoiDepth, TrainingProgress
from engine.core.learning_status import Figures, PatientMatch
from engine.core.motion_model import MotionModel, Provenance, TrainingQuality
from engine.motion.learning.fitting import fit
from engine.motion.learning.past_frames import PastBreaths, Stretch
from engine.motion.learning.patient_match import PatientMatchLimits, compare_with_patient
from engine.motion.learning.prepared_model import PreparedModel
from engine.motion.learning.reference_proposals import PastMotion
from engine.motion.learning.reference_transfer import Explain, ReferenceTransfer, compare_models, recent
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.learning.training_quality import (
    find_outliers,
    refuse_breathless,
    refuse_disturbed,
    refuse_moving,
    with_quality_maps,
)
from engine.motion.learning.training_set import MAX_GAP_S, TrainingFrame, TrainingSet, Vertices, evenly, mean_surface

QUALITY_FRAMES = 60
SURFACE_FRAMES = 120
SWITCH_SECONDS = 2.0
SWITCH_FRAMES = 30
COMPARE_FRAMES = 60
MIN_COMPARE_FRAMES = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningStages:
    """Functions of the pipeline that jobs need; pure, and methods of values where a job takes them to a process.

    Attributes
    ----------
    prepare
        Prepares a model for measuring.
    explain
        Projects a region on a prepared model; None if the model does not explain it well enough.
    vertices
        Computes the points of the surface at the nodes.
    measure_past
        Returns a measurement of frames from before a model, in order of time; it gives None where the model does not
        explain a frame well enough.
    present
        Returns the same for a job that starts now, with all that may change later as it is now; None where nothing
        does.
    """

    prepare: Callable[[MotionModel], PreparedModel]
    explain: Explain
    vertices: Vertices
    measure_past: Callable[[PreparedModel], Callable[[TrainingFrame], PastMotion | None]]
    present: Callable[[], "LearningStages"] | None = None

    def of_now(self) -> "LearningStages":
        """Return the stages for a job that starts now."""
        return self if self.present is None else self.present()


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Candidate:
    """A prepared model that can be used.

    Attributes
    ----------
    transfer
        Transfer of the reference; None without a reference, or if it must not be transferred.
    is_stored
        Whether it comes from an earlier fraction, and has to be compared with the patient.
    past_breaths
        What is known of the breaths before a first model; None for other models.
    """

    active: PreparedModel
    transfer: ReferenceTransfer | None = None
    is_stored: bool = False
    past_breaths: PastBreaths | None = None


Outcome = Candidate | PatientMatch


class LearningTask(Protocol):
    """Collects frames for a job."""

    def add(self, frame: TrainingFrame) -> None:
        """Add a frame."""

    @property
    def is_complete(self) -> bool:
        """Whether there are enough frames."""

    @property
    def needs_measured(self) -> bool:
        """Whether only frames that the present model explains are added."""

    @property
    def progress(self) -> TrainingProgress:
        """Progress of the collection."""

    def job(self, before: PreparedModel | None) -> Callable[[], Outcome]:
        """Return the job on the collected frames; ``before`` is the model in use."""


class FitTask:
    """Collects a training set and fits a model.

    Parameters
    ----------
    keeps_reference
        Whether the reference is transferred from the previous model; otherwise an operator has to set it again.
    """

    def __init__(
        self,
        settings: TrainingSettings,
        stages: LearningStages,
        calibration_sha256: str,
        *,
        keeps_reference: bool = True,
    ) -> None:
        self._settings, self._stages = settings, stages
        self._calibration_sha256 = calibration_sha256
        self._keeps_reference = keeps_reference
        self._set = TrainingSet(settings, stages.vertices)

    def add(self, frame: TrainingFrame) -> None:
        """Add a frame to the training set."""
        self._set.add(frame)

    @property
    def is_complete(self) -> bool:
        """Whether the training set is complete."""
        return self._set.is_complete

    @property
    def needs_measured(self) -> bool:
        """Whether only measured frames count: with a kept reference an object on the patient must not be learned."""
        return self._keeps_reference

    @property
    def progress(self) -> TrainingProgress:
        """Progress of the training set."""
        return self._set.progress

    def job(self, before: PreparedModel | None) -> Callable[[], Outcome]:
        """Return the job that checks the set, fits the model and transfers the reference."""
        return FitJob(
            training_set=self._set,
            stages=self._stages.of_now(),
            settings=self._settings,
            calibration_sha256=self._calibration_sha256,
            before=before if self._keeps_reference else None,
        )


class SwitchTask:
    """Collects two seconds of frames to transfer the reference to a stored model."""

    def __init__(self, model: MotionModel, settings: TrainingSettings, stages: LearningStages) -> None:
        self._model, self._settings, self._stages = model, settings, stages
        self._frames: list[TrainingFrame] = []

    def add(self, frame: TrainingFrame) -> None:
        """Add a frame; a gap restarts the collection."""
        _drop_before_gap(self._frames, frame)
        self._frames.append(frame)

    @property
    def is_complete(self) -> bool:
        """Whether there are two seconds of frames."""
        return len(self._frames) >= SWITCH_FRAMES and _seconds(self._frames) >= SWITCH_SECONDS

    @property
    def needs_measured(self) -> bool:
        """True: the present model has to explain the frames."""
        return True

    @property
    def progress(self) -> TrainingProgress:
        """Progress of the collection."""
        return _collection_progress(self._frames, SWITCH_SECONDS, "transferring the reference to another model")

    def job(self, before: PreparedModel | None) -> Callable[[], Outcome]:
        """Return the job that prepares the model and transfers the reference."""
        return SwitchJob(
            model=self._model,
            stages=self._stages.of_now(),
            before=before,
            frames=recent(self._frames),
            most_mm=self._settings.max_carry_mm,
        )


class CompareTask:
    """Collects frames to compare a stored model, which is in use meanwhile, with the patient."""

    def __init__(self, active: PreparedModel, limits: PatientMatchLimits, stages: LearningStages) -> None:
        self._active, self._limits, self._stages = active, limits, stages
        self._frames: list[TrainingFrame] = []

    def add(self, frame: TrainingFrame) -> None:
        """Add a frame if enough time has passed since the last one; a gap restarts the collection."""
        _drop_before_gap(self._frames, frame)
        step_us = self._limits.seconds * 1e6 / COMPARE_FRAMES
        if not self._frames or frame.timestamp_us - self._frames[-1].timestamp_us >= step_us:
            self._frames.append(frame)

    @property
    def is_complete(self) -> bool:
        """Whether there are enough frames over the time of the limits."""
        return len(self._frames) >= MIN_COMPARE_FRAMES and _seconds(self._frames) >= self._limits.seconds

    @property
    def needs_measured(self) -> bool:
        """False: frames that the model does not explain are the evidence of a mismatch."""
        return False

    @property
    def progress(self) -> TrainingProgress:
        """Progress of the collection."""
        return _collection_progress(self._frames, self._limits.seconds, "comparing the stored model with the patient")

    def job(self, before: PreparedModel | None) -> Callable[[], Outcome]:
        """Return the job that compares the model with the frames; the model in use is the stored one itself."""
        return CompareJob(
            active=before or self._active,
            frames=list(self._frames),
            limits=self._limits,
            stages=self._stages.of_now(),
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FitJob:
    """Checks a set, fits a model and transfers the reference of ``before``; nothing else adds to the set."""

    training_set: TrainingSet
    stages: LearningStages
    settings: TrainingSettings
    calibration_sha256: str
    before: PreparedModel | None

    def __call__(self) -> Candidate:
        """Return the new model; raise ModelError where the set is refused."""
        active, frames = fit_checked(self.training_set, self.stages, self.settings, self.calibration_sha256)
        most_mm = self.settings.max_carry_mm
        transfer = _transferred(self.before, active, recent(frames), self.stages, most_mm)
        return Candidate(active=active, transfer=transfer)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SwitchJob:
    """Prepares a stored model and transfers the reference of ``before``, by the frames."""

    model: MotionModel
    stages: LearningStages
    before: PreparedModel | None = None
    frames: Sequence[TrainingFrame] = ()
    most_mm: float = 0.0
    is_stored: bool = False

    def __call__(self) -> Candidate:
        """Return the prepared model; raise ModelError where the reference cannot be transferred."""
        active = self.stages.prepare(self.model)
        transfer = _transferred(self.before, active, self.frames, self.stages, self.most_mm)
        return Candidate(active=active, transfer=transfer, is_stored=self.is_stored)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CompareJob:
    """Compares a model with the patient's frames."""

    active: PreparedModel
    frames: Sequence[TrainingFrame]
    limits: PatientMatchLimits
    stages: LearningStages

    def __call__(self) -> PatientMatch:
        """Return the comparison."""
        stages = self.stages
        return compare_with_patient(
            self.active, self.frames, self.limits, explain=stages.explain, vertices=stages.vertices
        )


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PastBreathsJob:
    """The job of a first fit, which also finds the breaths of the frames so far."""

    job: Callable[[], Outcome]
    stretch: Stretch
    stages: LearningStages

    def __call__(self) -> Outcome:
        """Return the new model with the breaths."""
        outcome = self.job()
        assert isinstance(outcome, Candidate), "a fit gives a candidate"
        breaths = PastBreaths(outcome.active, self.stages.measure_past(outcome.active))
        breaths.follow(self.stretch)
        return replace(outcome, past_breaths=breaths)


def fit_checked(
    training_set: TrainingSet, stages: LearningStages, settings: TrainingSettings, calibration_sha256: str
) -> tuple[PreparedModel, list[TrainingFrame]]:
    """Check a training set, fit a model without its outliers and describe its quality; return it with the frames used.

    Raises
    ------
    ModelError
        The set is refused, or there is no model of it.
    """
    frames, signals = training_set.frames, training_set.signals
    amplitude_mm, noise_mm = refuse_breathless(signals, settings)
    shift_mm, tilt_deg = refuse_moving(frames, stages.vertices, settings, amplitude_mm)
    outliers = find_outliers(frames, signals, amplitude_mm)
    outlier_share = refuse_disturbed(outliers, settings)
    kept_frames = [frame for frame, is_outlier in zip(frames, outliers, strict=True) if not is_outlier]
    model = _fit(kept_frames, training_set, settings, calibration_sha256)
    model = replace(model, surface_mm=mean_surface(evenly(kept_frames, SURFACE_FRAMES), stages.vertices))
    active = stages.prepare(model)
    pairs = _explained(active, evenly(kept_frames, QUALITY_FRAMES), stages)
    explained = [outcome for _, outcome in pairs]
    quality = TrainingQuality(
        amplitude_mm=amplitude_mm,
        noise_mm=noise_mm,
        explained_share=min(float(model.spectrum[: len(model.components)].sum()), 1.0),
        shift_mm=shift_mm,
        tilt_deg=tilt_deg,
        outlier_share=outlier_share,
        residual_mm=float(np.median([outcome.residual_mm for outcome in explained])),
    )
    settings_used = {field.name: float(getattr(settings, field.name)) for field in fields(settings)}
    scores_mm = np.stack([outcome.beta for outcome in explained]).astype(np.float32)
    model = replace(model, scores_mm=scores_mm, provenance=Provenance(quality=quality, settings=settings_used))
    return replace(active, model=with_quality_maps(model, active.basis, pairs)), kept_frames


def _fit(
    kept_frames: list[TrainingFrame], training_set: TrainingSet, settings: TrainingSettings, calibration_sha256: str
) -> MotionModel:
    return fit(
        np.stack([frame.roi.depth_mm for frame in kept_frames]),
        np.stack([frame.roi.valid for frame in kept_frames]),
        components=settings.components,
        cycles=training_set.cycles,
        seconds=training_set.seconds,
        calibration_sha256=calibration_sha256,
    )


def _transferred(
    before: PreparedModel | None,
    active: PreparedModel,
    frames: Sequence[TrainingFrame],
    stages: LearningStages,
    most_mm: float,
) -> ReferenceTransfer | None:
    if before is None:
        return None
    transfer = compare_models(before, active, frames, explain=stages.explain, vertices=stages.vertices)
    if not transfer.correction_mm <= most_mm:
        raise TrainingRefusedError(
            "carry.correction_mm",
            f"{transfer.correction_mm:.2f}",
            f"at most {most_mm:g}",
            "the two models disagree on the patient's position: the camera or the patient has moved; train again "
            "without keeping the reference, then set it",
        )
    return transfer


def _explained(
    active: PreparedModel, frames: list[TrainingFrame], stages: LearningStages
) -> list[tuple[RoiDepth, Projection]]:
    """Project training frames on the model learned from them; raise TrainingRefusedError if none is explained."""
    outcomes = [(frame.roi, stages.explain(active, frame.roi, None)) for frame in frames]
    explained = [(roi, outcome) for roi, outcome in outcomes if outcome is not None]
    if not explained:
        raise TrainingRefusedError(
            "training.explained", "no frame", "explained by its own model", "clear the view of the camera"
        )
    return explained


def _drop_before_gap(frames: list[TrainingFrame], frame: TrainingFrame) -> None:
    """Clear the frames after a gap or a step back of the device's clock: the patient may have moved."""
    if frames and not 0.0 < (frame.timestamp_us - frames[-1].timestamp_us) / 1e6 <= MAX_GAP_S:
        frames.clear()


def _seconds(frames: list[TrainingFrame]) -> float:
    return (frames[-1].timestamp_us - frames[0].timestamp_us) / 1e6 if frames else 0.0


def _collection_progress(frames: list[TrainingFrame], needed_s: float, note: str) -> TrainingProgress:
    seconds = _seconds(frames)
    return TrainingProgress(
        frames=len(frames), cycles=0, seconds=seconds, share=min(max(seconds / needed_s, 0.0), 1.0), note=note
    )


def quality_figures(model: MotionModel) -> Figures:
    """Return the quality figures of a model's training for a learning event."""
    quality = model.provenance.quality
    quality_values = {} if quality is None else {name: round(value, 4) for name, value in asdict(quality).items()}
    return {"frames": model.training_frames, "cycles": model.cycles, **quality_values}
