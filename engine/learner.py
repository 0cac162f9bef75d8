"""What is learned, and what counts as zero: gathers frames, has models fitted, swaps them between two frames.

Owned by the pipeline's thread. Kept apart from the measuring: a frame's way does not know how models come about.
"""

from collections.abc import Callable
from dataclasses import replace

from engine.active_model import ActiveModel, Reference
from engine.errors import CommandRefusedError, ModelError
from engine.frames import FloatArray, RoiDepth, TrainingProgress
from engine.model import MotionModel
from engine.training import Trainer, TrainingSet, TrainingSettings


class Learner:
    """The present model and its zero, and the next model on its way.

    Parameters
    ----------
    prepare
        Works everything out that frames will need of a model; called wherever the trainer runs.
    """

    def __init__(
        self,
        *,
        calibration_sha256: str,
        settings: TrainingSettings,
        prepare: Callable[[MotionModel], ActiveModel],
        trainer: Trainer[ActiveModel],
    ) -> None:
        self._calibration_sha256 = calibration_sha256
        self._settings = settings
        self._prepare = prepare
        self._trainer = trainer
        self._training: TrainingSet | None = TrainingSet(settings)
        self._training_failure = ""
        self._active: ActiveModel | None = None
        self._reference: Reference | None = None
        self._is_reference_wanted = False
        self._generation = 0

    @property
    def active(self) -> ActiveModel | None:
        """The model frames are measured with now, made ready."""
        return self._active

    @property
    def shortcoming(self) -> str | None:
        """Why nobody may arm with the present model; None when it will do, or when there is none."""
        needed = self._settings.min_cycles
        if self._active is None or self._active.model.cycles >= needed:
            return None
        return (
            f"the motion model was learned from {self._active.model.cycles} complete breathing cycles and {needed} are "
            "needed: learn again while the patient breathes calmly"
        )

    @property
    def has_reference(self) -> bool:
        """Whether there is a zero to measure from."""
        return self._reference is not None and not self._is_reference_wanted

    @property
    def generation(self) -> int:
        """Changes whenever the model or the reference did: what was armed before is armed no more."""
        return self._generation

    @property
    def is_gathering(self) -> bool:
        """Whether frames are wanted for a new model."""
        return self._training is not None

    @property
    def progress(self) -> TrainingProgress | None:
        """How far the learning has come; None while nothing is being learned."""
        if self._training is not None:
            progress = self._training.progress
            return replace(progress, note=self._training_failure) if self._training_failure else progress
        if self._trainer.is_busy:
            return TrainingProgress(frames=0, cycles=0, seconds=0.0, share=1.0, note="fitting the model")
        return None

    def set_reference(self) -> None:
        """Take the next measured frame as the zero of motion."""
        if self._active is None:
            msg = "there is no motion model yet: a reference needs one"
            raise CommandRefusedError(msg)
        self._is_reference_wanted = True
        self._generation += 1

    def reference(self, active: ActiveModel, coefficients: FloatArray, surface: FloatArray) -> Reference:
        """Return the zero of motion; the position given here when there is none yet or a new one is wanted."""
        if self._reference is None or self._is_reference_wanted:
            self._reference = active.reference(coefficients, surface)
            self._is_reference_wanted = False
        return self._reference

    def retrain(self) -> None:
        """Gather frames for a new model; the present one measures on until the new one is ready."""
        if self._trainer.is_busy:
            msg = "a model is being fitted already"
            raise CommandRefusedError(msg)
        self._training = TrainingSet(self._settings)
        self._training_failure = ""

    def activate(self, model: MotionModel) -> None:
        """Measure with this model as soon as it is prepared; the reference is carried over."""
        if model.calibration_sha256 != self._calibration_sha256:
            msg = "the model was learned with another calibration"
            raise ModelError(msg)
        if self._trainer.is_busy:
            msg = "a model is being fitted already"
            raise CommandRefusedError(msg)
        self._trainer.start(lambda: self._prepare(model))
        self.collect()

    def learn(self, roi: RoiDepth, timestamp_us: int) -> None:
        """Take a frame for the model that is being learned; have it fitted when there are enough."""
        if self._training is None:
            return
        self._training.add(roi, timestamp_us)
        if self._training.is_complete and not self._trainer.is_busy:
            fit = self._training.job(self._calibration_sha256)
            self._trainer.start(lambda: self._prepare(fit()))
            self._training = None
            self.collect()

    def collect(self) -> None:
        """Swap to a model that has become ready; call between two frames."""
        if not self._trainer.is_busy:
            return
        outcome = self._trainer.collect()
        if isinstance(outcome, ActiveModel):
            self._active = outcome
            self._generation += 1
        elif isinstance(outcome, ModelError):
            self._training_failure = str(outcome)
            self._training = TrainingSet(self._settings)
