"""The model's life: frames are collected, a job fits or compares, a candidate waits, a model is in use.

The present model is used until another is ready; while the gate is armed, the new model waits.
"""

import enum
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from engine.core.errors import CommandRefusedError, ModelError, ModelMismatchError, SourceAwayError
from engine.core.frames import TrainingProgress
from engine.core.learning_status import LearningEventKind, PatientMatch
from engine.core.motion_model import MotionModel
from engine.core.sentences import say
from engine.motion.learning.depth_steps import StepsJob, steps_mismatch
from engine.motion.learning.learning_journal import LearningJournal, match_figures, transfer_figures
from engine.motion.learning.past_frames import PastFollower
from engine.motion.learning.patient_match import PatientMatchLimits
from engine.motion.learning.prepared_model import PreparedModel
from engine.motion.learning.reference import PatientReference
from engine.motion.learning.tasks import (
    Candidate,
    CompareTask,
    FitTask,
    LearningStages,
    LearningTask,
    Outcome,
    PastBreathsJob,
    SwitchJob,
    SwitchTask,
)
from engine.motion.learning.trainer import Trainer, TrainingSettings

if TYPE_CHECKING:
    from engine.motion.learning.refit import SessionRefits
    from engine.motion.learning.training_set import TrainingFrame

BUSY = say("a model is being fitted already")
DROPPED = say("the training in progress or the waiting model was dropped: the camera was disconnected")
COMPARING = say("the stored model is still being compared with the patient: wait a few seconds")


class Job(enum.Enum):
    """What the trainer does."""

    NONE = enum.auto()
    RUNS = enum.auto()
    REFITS = enum.auto()
    """The engine has started it, not a person."""
    DROPPED = enum.auto()
    """Its outcome will be discarded."""


class JobEvent(enum.Enum):
    """What happens to a job."""

    START = enum.auto()
    REFIT = enum.auto()
    RETRAIN = enum.auto()
    LOSE = enum.auto()
    """The camera was disconnected."""
    END = enum.auto()


JOBS: dict[tuple[Job, JobEvent], Job] = {
    (Job.NONE, JobEvent.START): Job.RUNS,
    (Job.NONE, JobEvent.REFIT): Job.REFITS,
    (Job.NONE, JobEvent.RETRAIN): Job.NONE,
    (Job.REFITS, JobEvent.RETRAIN): Job.DROPPED,
    (Job.DROPPED, JobEvent.RETRAIN): Job.DROPPED,
    (Job.NONE, JobEvent.LOSE): Job.NONE,
    (Job.RUNS, JobEvent.LOSE): Job.DROPPED,
    (Job.REFITS, JobEvent.LOSE): Job.DROPPED,
    (Job.DROPPED, JobEvent.LOSE): Job.DROPPED,
    (Job.RUNS, JobEvent.END): Job.NONE,
    (Job.REFITS, JobEvent.END): Job.NONE,
    (Job.DROPPED, JobEvent.END): Job.NONE,
}
"""What becomes of a job; what is not here is refused."""


def next_job(job: Job, event: JobEvent) -> Job:
    """Return what becomes of a job; raise CommandRefusedError where that is not possible now."""
    after = JOBS.get((job, event))
    if after is None:
        raise CommandRefusedError(BUSY)
    return after


class Comparison(enum.Enum):
    """Whether the model in use, a stored one, is being compared with the patient."""

    NONE = enum.auto()
    FIRST = enum.auto()
    """A refusal is repeated once: a hand in view costs no model."""
    LAST = enum.auto()


@dataclass(frozen=True, slots=True, kw_only=True)
class LearningSetup:
    """What models are learned with, the same for the whole session."""

    calibration_sha256: str
    settings: TrainingSettings
    match_limits: PatientMatchLimits
    stages: LearningStages
    most_noise_mm: float | None = None


class ModelLifecycle:
    """The model in use and the next one; owned by the pipeline's thread.

    Attributes
    ----------
    active
        The model in use, prepared for measuring; None before the first.
    candidate
        A model that waits while the gate is armed.
    patient_match
        The newest comparison of a stored model with the patient.
    depth_steps
        Of the sensor's readings, set before a frame is learned; models are stored with them.
    is_held
        Whether the present model must stay in use, because the gate is armed.
    """

    def __init__(
        self,
        setup: LearningSetup,
        *,
        trainer: Trainer[Outcome],
        journal: LearningJournal,
        reference: PatientReference,
        past: PastFollower,
        refits: "SessionRefits",
    ) -> None:
        self.setup, self._trainer, self._journal = setup, trainer, journal
        self._reference, self._past, self._refits = reference, past, refits
        self.active: PreparedModel | None = None
        self.candidate: Candidate | None = None
        self.patient_match: PatientMatch | None = None
        self.depth_steps: tuple[float, ...] | None = None
        self.is_held = False
        self._task: LearningTask | None = None
        self._job = Job.NONE
        self._started_with: PreparedModel | None = None
        self._comparison = Comparison.NONE
        self._learned_us = 0
        self.begin_learning()

    @property
    def shortcoming(self) -> str | None:
        """Why the gate is not armed with the model in use; None where it may be."""
        if self.active is None:
            return None
        if self._comparison is not Comparison.NONE:
            return COMPARING
        noise_mm, most_mm = self.active.model.noise_mm, self.setup.most_noise_mm
        if most_mm is not None and noise_mm > most_mm:
            return say(
                "the camera's readings had {noise_mm:.0f} mm of noise in the training, and a camera of its kind has at "
                "most {most_mm:.0f}: look for the sun or a second projector, then train again",
                noise_mm=noise_mm,
                most_mm=most_mm,
            )
        cycles, needed = self.active.model.cycles, self.setup.settings.min_cycles
        if cycles >= needed:
            return None
        return say(
            "the motion model was learned from {cycles} complete breathing cycles and {needed} are needed: "
            "train again while the patient breathes calmly",
            cycles=cycles,
            needed=needed,
        )

    @property
    def is_gathering(self) -> bool:
        """Whether a task collects frames."""
        return self._task is not None

    @property
    def takes_lost_frames(self) -> bool:
        """Whether the task also takes frames that the present model does not explain."""
        return self.active is None or (self._task is not None and not self._task.needs_measured)

    @property
    def progress(self) -> TrainingProgress | None:
        """Progress of the training; None without a training or a recent refusal."""
        refusal = self._journal.refusal
        if self._task is not None:
            progress = self._task.progress
            return replace(progress, note=refusal) if refusal and not progress.note else progress
        if self._job is not Job.NONE:
            return _note(say("fitting the model"), share=1.0)
        if self.candidate is not None:
            return _note(say("a new model is ready: it is used when the gate is disarmed"), share=1.0)
        return _note(refusal, share=0.0) if refusal and self._journal.recent_refusal else None

    # -- commands -----------------------------------------------------------------------------------------------

    def begin_learning(self, *, keeps_reference: bool = True) -> None:
        """Collect frames for a new model."""
        setup = self.setup
        self._task = FitTask(setup.settings, setup.stages, setup.calibration_sha256, keeps_reference=keeps_reference)
        self._past.clear()
        self._refits.begin()

    def retrain(self, *, keeps_reference: bool) -> None:
        """Collect frames for a new model; the present one stays in use until the new one is ready.

        A refit in progress is dropped: it was started by the engine, this by a person.
        """
        if self._comparison is not Comparison.NONE:
            raise CommandRefusedError(COMPARING)
        self._job = next_job(self._job, JobEvent.RETRAIN)
        self.begin_learning(keeps_reference=keeps_reference)
        self._journal.refusal = ""

    def activate(self, model: MotionModel) -> None:
        """Use a stored model of this session after the reference was transferred to it."""
        self._refuse_unusable(model)
        mismatch = steps_mismatch(model, self.depth_steps)
        if mismatch is not None:
            raise mismatch
        self._journal.refusal = ""
        self._refits.stop()
        if self.active is not None:
            self._task = SwitchTask(model, self.setup.settings, self.setup.stages)
            return
        self._task = None
        self.start(SwitchJob(model=model, stages=self.setup.stages.of_now()))

    def resume(self, model: MotionModel) -> None:
        """Start with a model of an earlier fraction; it is compared with the patient before the gate can be armed.

        Its reference is not transferred, as the patient's position may differ. Motion is relative to the first frame
        until an operator sets the reference.
        """
        self._refuse_unusable(model)
        if model.surface_mm is None:
            raise ModelMismatchError("model", "of an older version", "one that stores its patient's surface")
        self._task = None
        self._refits.stop()
        self.start(SwitchJob(model=model, stages=self.setup.stages.of_now(), is_stored=True))

    def _refuse_unusable(self, model: MotionModel) -> None:
        """Refuse a model of another calibration, and any while the trainer or a comparison is busy."""
        expected = self.setup.calibration_sha256
        if model.calibration_sha256 != expected:
            bound = f"the session's calibration, {expected[:12]}"
            raise ModelMismatchError("model.calibration_sha256", model.calibration_sha256[:12], bound)
        if self._comparison is not Comparison.NONE:
            raise CommandRefusedError(COMPARING)
        next_job(self._job, JobEvent.START)

    def use(self, active: PreparedModel | None, patient_match: PatientMatch | None) -> None:
        """Use a model that was learned elsewhere from the same frames; learn nothing."""
        self.active, self.patient_match, self._task = active, patient_match, None
        self._refits.stop()

    def restart(self) -> None:
        """Restart after the camera was disconnected: camera or patient may have moved.

        The model stays in use and is compared with the patient like a stored one. Collected frames, a running fit and a
        waiting model are dropped. Without a model, training restarts.
        """
        is_fitted, is_gathered = self._job in {Job.RUNS, Job.REFITS}, self._task is not None and self.active is not None
        is_requested = self._comparison is Comparison.NONE and (is_fitted or is_gathered)
        if self.candidate is not None or is_requested:
            self._journal.refuse(DROPPED, {"code": SourceAwayError.code})
        self.candidate, self._task, self.patient_match = None, None, None
        self._job = next_job(self._job, JobEvent.LOSE)
        self._reference.drop()
        self._journal.change()
        if self.active is None or self.active.model.surface_mm is None:
            self.active, self._comparison = None, Comparison.NONE
            self.begin_learning()
            return
        self._refits.stop()
        self._reference.is_needed = True
        self._compare(self.active, Comparison.FIRST)
        detail = say("the camera was disconnected: set the reference before arming")
        self._journal.emit(LearningEventKind.ZERO_NEEDED, detail)

    # -- between and at frames ----------------------------------------------------------------------------------

    def learn(self, frame: "TrainingFrame") -> None:
        """Add a frame to the current task; start its job when the task is complete."""
        task = self._task
        if task is None or self._job is not Job.NONE:
            return
        task.add(frame)
        if task.is_complete:
            self._task = None
            job = task.job(self.active)
            if isinstance(task, FitTask):
                job = StepsJob(job=job, steps=self.depth_steps)
            if self.active is None:
                job = PastBreathsJob(job=job, stretch=self._past.stretch, stages=self.setup.stages.of_now())
            self.start(job)

    def refit_if_due(self) -> None:
        """Start a refit to the session so far that has become due."""
        is_free = not self.is_held and self._task is None and self._job is Job.NONE
        job = self._refits.job(self.active) if is_free and self.active is not None else None
        if job is not None:
            self._journal.emit(LearningEventKind.STARTED, say("the model is refitted to the session so far"))
            self.start(StepsJob(job=job, steps=self.depth_steps), JobEvent.REFIT)

    def begin_frame(self) -> None:
        """Between two frames: take the trainer's result, switch models if allowed, start a training that is due."""
        if self._job is not Job.NONE:
            self.collect()
        if self.candidate is not None:
            self.switch_if_allowed()
        if self.setup.settings.retrain_interval_s > 0.0:
            self._retrain_if_due()

    def _retrain_if_due(self) -> None:
        """Start a training where the interval of retraining has passed."""
        interval_s, now_us = self.setup.settings.retrain_interval_s, self._journal.now_us
        self._learned_us = min(self._learned_us, now_us)  # the device's clock may restart
        is_free = self.active is not None and self._task is None and self._job is Job.NONE
        if is_free and now_us - self._learned_us >= interval_s * 1e6:
            self.begin_learning()
            figures = {"interval_s": interval_s}
            self._journal.emit(LearningEventKind.STARTED, say("the retraining interval has passed"), figures)

    def start(self, job: Callable[[], Outcome], event: JobEvent = JobEvent.START) -> None:
        """Hand a job to the trainer."""
        self._job, self._started_with = next_job(self._job, event), self.active
        self._trainer.start(job)
        self.collect()

    def collect(self) -> None:
        """Take the trainer's outcome, if there is one, and use it if that is allowed now."""
        outcome = None if self._job is Job.NONE else self._trainer.collect()
        if outcome is None:
            return
        before, self._job = self._job, next_job(self._job, JobEvent.END)
        started_with, self._started_with = self._started_with, None
        if before is Job.DROPPED:
            return
        match outcome:
            case Candidate():
                self._receive(outcome, started_with)
            case PatientMatch():
                self._receive_match(outcome)
            case ModelError():
                self._refuse(outcome)

    def _receive(self, candidate: Candidate, started_with: PreparedModel | None) -> None:
        self._learned_us = self._journal.now_us
        if started_with is not self.active:  # cannot happen: models are not switched while the trainer is busy
            self._refuse(ModelError(say("another model is in use by now")))
            return
        if self.active is not None:
            figures = transfer_figures(candidate, self._reference.current)
            self._journal.emit(LearningEventKind.READY, say("a new model is ready"), figures)
        self.candidate = candidate
        self.switch_if_allowed()

    def switch_if_allowed(self) -> None:
        """Use the waiting model unless the gate is armed."""
        if self.candidate is not None and not self.is_held:
            self.switch(self.candidate)

    def switch(self, candidate: Candidate) -> None:
        """Use another model; the reference is transferred to it, or has to be set again."""
        figures = transfer_figures(candidate, self._reference.current)
        self.candidate = None
        is_transferred = self._reference.transfer(candidate.transfer)
        self.active = candidate.active
        self._journal.change(is_position_new=not is_transferred)
        self._journal.refusal = ""
        self._journal.emit(LearningEventKind.SWAPPED, say("a new model is in use"), figures)
        if not is_transferred:
            detail = say("a new model without a reference: set it before arming")
            self._journal.emit(LearningEventKind.ZERO_NEEDED, detail)
        self._past.begin(candidate.past_breaths)
        self._reference.use_past()
        if candidate.is_stored:
            self._compare(candidate.active, Comparison.FIRST)

    def _compare(self, active: PreparedModel, comparison: Comparison) -> None:
        """Compare the model in use with the patient."""
        self._comparison = comparison
        self._task = CompareTask(active, self.setup.match_limits, self.setup.stages)

    def _receive_match(self, patient_match: PatientMatch) -> None:
        may_repeat = self._comparison is Comparison.FIRST and patient_match.refusal is not None
        if patient_match.refusal is None and self.active is not None:
            patient_match = replace(patient_match, refusal=steps_mismatch(self.active.model, self.depth_steps))
        self.patient_match, self._comparison = patient_match, Comparison.NONE
        detail = say("the stored model was compared with the patient")
        self._journal.emit(LearningEventKind.COMPARED, detail, match_figures(patient_match))
        if patient_match.refusal is None:
            return
        if may_repeat and self.active is not None:
            self._compare(self.active, Comparison.LAST)
        else:
            self._refuse(patient_match.refusal, drops_model=True)

    def _refuse(self, error: ModelError, *, drops_model: bool = False) -> None:
        """Report a refusal; without a model in use, restart the training."""
        bounds = {name: getattr(error, name, None) for name in ("field", "value", "bound")}
        self._journal.refuse(str(error), {"code": error.code, **bounds})
        self._learned_us = self._journal.now_us
        if drops_model or self._comparison is not Comparison.NONE:
            self.active, self._comparison = None, Comparison.NONE
            self._reference.drop()
            self._journal.change()
        if self.active is None:
            self.begin_learning()


def _note(text: str, *, share: float) -> TrainingProgress:
    return TrainingProgress(frames=0, cycles=0, seconds=0.0, share=share, note=text)
