"""Manages the motion model and the reference: collects frames, starts fits, switches models between two frames.

Owned by the pipeline's thread, and separate from measuring: the frame path does not depend on how models are made. The
present model is used until another is ready; while the gate is armed, the new model waits.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

from engine.core.breath import Breath, SignalChoice
from engine.core.errors import CommandRefusedError, ModelError, ModelMismatchError, SourceAwayError
from engine.core.first_reference import FirstReference
from engine.core.frames import FloatArray, Motion, TrainingProgress
from engine.core.learning_events import Figures, LearningEvent, LearningEventKind
from engine.core.learning_status import LearningStatus
from engine.core.motion_model import MotionModel
from engine.core.patient_match import PatientMatch
from engine.core.position_check import PositionCheck
from engine.core.ranges import LearnedLevels, Ranges
from engine.core.reference_distance import ReferenceDistance
from engine.core.reference_proposal import ReferenceMoment, ReferenceProposal
from engine.motion.learning.depth_steps import StepsJob, steps_mismatch
from engine.motion.learning.event_figures import distance_figures, match_figures, position_figures, transfer_figures
from engine.motion.learning.learned import Learned
from engine.motion.learning.learned_range import learned_levels, learned_ranges
from engine.motion.learning.past_frames import FOLLOWED_AT_ONCE, PastBreaths, PastFrames
from engine.motion.learning.patient_match import PatientMatchLimits
from engine.motion.learning.prepared_model import PreparedModel, Reference
from engine.motion.learning.reference_history import ReferenceHistory
from engine.motion.learning.reference_proposals import MAX_GAP_US, ReferenceProposals
from engine.motion.learning.refit import Refits
from engine.motion.learning.seen_shares import of_regions
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
from engine.motion.learning.training_set import TrainingFrame

REFUSAL_SHOWN_S = 30.0
"""How long a refusal is shown while the previous model is in use [s]."""

BUSY = "a model is being fitted already"
DROPPED = "the training in progress or the waiting model was dropped: the camera was disconnected"
TOO_FEW_BREATHS = "fewer than two breaths are known since the patient lies here: wait until the patient has breathed"
FIRST = "the first reference of this fraction: later ones are measured from it"
COMPARING = "the stored model is still being compared with the patient: wait a few seconds"


class _Newest(NamedTuple):
    """The newest measured frame: coefficients, shape (k + e,), and device time [us]."""

    active: PreparedModel
    coefficients: FloatArray
    motion: Motion
    at_us: int


class Learner:
    """The present model, its reference, and the next model in progress.

    A person sets the reference. Until then motion is relative to the first measured frame, and the gate is not armed.

    ``history`` keeps the fraction's first reference. ``depth_steps`` are those of the sensor's readings, set before a
    frame is learned; models are stored with them.
    """

    def __init__(
        self,
        *,
        calibration_sha256: str,
        settings: TrainingSettings,
        match_limits: PatientMatchLimits,
        stages: LearningStages,
        trainer: Trainer[Outcome],
        history: ReferenceHistory,
    ) -> None:
        self._calibration_sha256 = calibration_sha256
        self._settings, self._limits = settings, match_limits
        self._stages = stages
        self._trainer = trainer
        self._history = history
        self._distance: ReferenceDistance | None = None
        self._position_check: PositionCheck | None = None
        self._most_mm: float | None = None
        self._newest: _Newest | None = None
        self._task: LearningTask | None = None
        self._refits: Refits | None = None
        self._past = PastFrames(stages.vertices)
        self._past_breaths: PastBreaths | None = None
        self._active: PreparedModel | None = None
        self._started_with: PreparedModel | None = None
        self._begin_learning()
        self._candidate: Candidate | None = None
        self._reference: Reference | None = None
        self._is_reference_requested = False
        self._requested_position: Reference | None = None
        self._requested_moment = ReferenceMoment.NOW
        self.is_reference_end_exhale = False
        """Whether the reference was set to the mean of the last ends of exhale."""
        self._requested_us = 0
        self._proposals = ReferenceProposals()
        self._proposed: tuple[ReferenceProposal, ...] = ()
        self._proposed_for = -1
        self._needs_reference = False
        self._reference_number = 0
        self._is_model_held = False
        self._is_comparing = False
        self._discards_outcome, self._is_refitting = False, False
        self._patient_match: PatientMatch | None = None
        self._may_compare_again = False
        self._generation = 0
        self._position_generation = 0
        self._now_us = 0
        self._learned_us = 0
        self._refusal = ""
        self._refused_us = 0
        self._notices: list[LearningEvent] = []
        self.depth_steps: tuple[float, ...] | None = None

    @property
    def active(self) -> PreparedModel | None:
        """The model in use, prepared for measuring."""
        return self._active

    @property
    def status(self) -> LearningStatus:
        """The model and the reference in use."""
        has_reference = self._reference is not None and not self._is_reference_requested and not self._needs_reference
        return LearningStatus(
            model=None if self._active is None else self._active.model,
            model_shortcoming=self._shortcoming(),
            model_generation=self._generation,
            is_model_waiting=self._candidate is not None,
            has_reference=has_reference,
            reference_number=self._reference_number,
            reference_proposals=self._proposed,
            reference_distance=self._distance if has_reference else None,
            patient_match=self._patient_match,
            position_check=self._position_check if has_reference else None,
            is_position_required=self._history.has_plan,
            is_fraction_continued=self._history.is_continued,
        )

    def _shortcoming(self) -> str | None:
        if self._active is None:
            return None
        if self._is_comparing:
            return COMPARING
        cycles, needed = self._active.model.cycles, self._settings.min_cycles
        if cycles >= needed:
            return None
        return (
            f"the motion model was learned from {cycles} complete breathing cycles and {needed} are needed: "
            "train again while the patient breathes calmly"
        )

    @property
    def is_reference_due(self) -> bool:
        """Whether the next measured frame becomes the reference."""
        return self._reference is None or self._is_reference_requested

    @property
    def generation(self) -> int:
        """Number that changes with every change of model or reference, which disarms the gate."""
        return self._generation

    @property
    def position_generation(self) -> int:
        """Number that changes with every change except that to a model which takes the reference over."""
        return self._position_generation

    @property
    def is_gathering(self) -> bool:
        """Whether a task collects frames."""
        return self._task is not None

    @property
    def takes_lost_frames(self) -> bool:
        """Whether the task also takes frames that the present model does not explain."""
        return self._active is None or (self._task is not None and not self._task.needs_measured)

    @property
    def progress(self) -> TrainingProgress | None:
        """Progress of the training; None without a training or a recent refusal."""
        if self._task is not None:
            progress = self._task.progress
            return replace(progress, note=self._refusal) if self._refusal and not progress.note else progress
        if self._trainer.is_busy:
            return _note("fitting the model", share=1.0)
        if self._candidate is not None:
            return _note("a new model is ready: it is used when the gate is disarmed", share=1.0)
        if self._refusal and self._now_us - self._refused_us <= REFUSAL_SHOWN_S * 1e6:
            return _note(self._refusal, share=0.0)
        return None

    def take_notices(self) -> list[LearningEvent]:
        """Return the events since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def keep_model(self, *, is_kept: bool) -> None:
        """Set whether the present model must stay in use, because the gate is armed."""
        self._is_model_held = is_kept

    # -- reference ----------------------------------------------------------------------------------------------

    def continue_fraction(self, first: FirstReference) -> None:
        """Measure distances from the first reference of this fraction, which an earlier session has set."""
        self._history.restore(first)

    def continue_plan(self, plan: FirstReference) -> None:
        """Compare the patient's position with that of the plan, which another fraction has set."""
        self._history.restore_plan(plan)

    def reference_distance(self, moment: ReferenceMoment) -> ReferenceDistance | None:
        """Return how far the position that would become the reference lies from the fraction's first; None without one.

        The present position is that of the newest frame.
        """
        if self._active is None:
            return None
        position = self._newest_position() if moment is ReferenceMoment.NOW else self._position(moment, self._now_us)
        return self._history.distance(self._active, position)

    def _newest_position(self) -> Reference | None:
        newest = self._newest
        if newest is None or newest.active is not self._active or not 0 <= self._now_us - newest.at_us <= MAX_GAP_US:
            return None
        return newest.active.reference(newest.coefficients, newest.motion.surface_mm, of_regions(newest.motion.seen))

    def _position(self, moment: ReferenceMoment, now_us: int) -> Reference:
        position = self._proposals.position(moment, now_us)
        if position is None:
            raise CommandRefusedError(TOO_FEW_BREATHS)
        return position

    def set_reference(self, moment: ReferenceMoment = ReferenceMoment.NOW, *, most_mm: float | None = None) -> None:
        """Make the position at the last ends of exhale or inhale, or in the next measured frame, the reference.

        One that lies further than ``most_mm`` from the fraction's first, or at an unknown distance, is dropped when it
        is taken up; None accepts any.

        Raises
        ------
        CommandRefusedError
            There is no model yet, or fewer than two such breaths are known.
        """
        if self._active is None:
            msg = "there is no motion model yet: a reference needs one"
            raise CommandRefusedError(msg)
        position = None if moment is ReferenceMoment.NOW else self._position(moment, self._now_us)
        self._is_reference_requested, self._requested_position, self._most_mm = True, position, most_mm
        self._requested_moment = moment
        self._requested_us = self._now_us
        self._change()

    def reference(self, present: Callable[[], Reference]) -> Reference:
        """Return the reference; a requested position, or the present one, becomes it if it is due."""
        if self._reference is None or self._is_reference_requested:
            self._reference = self._requested_position or present()
            self._reference_number += 1
            is_exhale = self._requested_moment is ReferenceMoment.END_EXHALE
            self.is_reference_end_exhale = self._is_reference_requested and is_exhale
            if self._is_reference_requested:
                self._confirm(self._reference)
            self._is_reference_requested, self._requested_position = False, None
        return self._reference

    def _confirm(self, reference: Reference) -> None:
        """Accept a reference that a person confirmed, unless it lies further from the first than was allowed."""
        if self._active is None:
            return
        moment = self._requested_moment
        self._distance, first = self._history.confirm(self._active, reference, moment)
        self._position_check = self._place(reference, moment)
        self._needs_reference = first is None and not self._distance.is_within(self._most_mm)
        if self._needs_reference:
            detail = f"the reference was dropped, because it lies {self._distance.text}: set it again"
            self._emit(LearningEventKind.ZERO_NEEDED, detail, distance_figures(self._distance))
            return
        detail = FIRST if first is not None else f"the reference lies {self._distance.text}"
        figures = {**distance_figures(self._distance), **position_figures(self._position_check)}
        self._emit(LearningEventKind.REFERENCE_SET, detail, figures, first)

    def follow(self, coefficients: FloatArray, motion: Motion, breath: Breath, timestamp_us: int) -> None:
        """Add a measured frame to the positions that are proposed as the reference."""
        if self._active is None:
            return
        is_model_new = self._newest is not None and self._newest.active is not self._active
        self._newest = _Newest(self._active, coefficients, motion, timestamp_us)
        is_new = self._proposals.follow(self._active, coefficients, motion, breath, timestamp_us)
        if is_model_new:  # the first frame of a model has enough to do: the next one compares
            self._proposed_for = -1
        elif is_new or self._proposed_for != self._generation:
            self._proposed_for = self._generation
            ranges = self.learned_ranges((breath.signal,))
            self._proposed = tuple(
                self._compared(one, self._active, self._position(one.moment, timestamp_us))
                for one in self._proposals.proposals(ranges, timestamp_us)
            )

    def _compared(self, one: ReferenceProposal, active: PreparedModel, position: Reference) -> ReferenceProposal:
        """Return a proposal with its distance from the fraction's first reference, and its place against the plan's.

        The latter takes milliseconds: it is left out while the gate is armed, and for the end of inhale.
        """
        is_compared = not self._is_model_held and one.moment is ReferenceMoment.END_EXHALE
        return replace(
            one,
            distance=self._history.distance(active, position),
            position_check=self._place(position, one.moment) if is_compared else None,
        )

    def _place(self, reference: Reference, moment: ReferenceMoment) -> PositionCheck | None:
        """Return where a reference lies against the plan's position; None without one."""
        return self._history.position(reference, moment)

    @property
    def levels_from(self) -> Reference | None:
        """The reference of the levels from before the model, until `move_levels`; None where there are none."""
        return self._proposals.measured_from

    def move_levels(self, before: Motion, now: Motion) -> None:
        """Measure the proposed levels from a new reference: the motion of one frame from the old and the new one."""
        self._proposals.move(before, now)

    def _drop_late_request(self) -> None:
        """Drop a requested reference that no measured frame has taken up: the patient may lie elsewhere by now."""
        if not self._is_reference_requested or 0 <= self._now_us - self._requested_us <= MAX_GAP_US:
            return
        self._is_reference_requested, self._needs_reference = False, True
        self._forget_positions()
        self._change()
        detail = "the reference was not set, because the patient was not measured for a second: set it again"
        self._emit(LearningEventKind.ZERO_NEEDED, detail)

    def _forget_positions(self) -> None:
        self._proposals.clear()
        self._past_breaths = None
        self._proposed, self._requested_position = (), None

    def learned_ranges(self, choices: Iterable[SignalChoice]) -> Ranges:
        """Return the range of each signal in the training relative to the reference; empty without a reference."""
        if self._active is None or self._reference is None or self._is_reference_requested:
            return {}
        return learned_ranges(self._active, self._reference, choices)

    def learned_levels(self, choices: Iterable[SignalChoice]) -> LearnedLevels:
        """Return the levels of each signal in the training relative to the reference; empty without a reference."""
        if self._active is None or self._reference is None or self._is_reference_requested:
            return {}
        return learned_levels(self._active, self._reference, choices)

    # -- commands -----------------------------------------------------------------------------------------------

    def retrain(self, *, keeps_zero: bool = True) -> None:
        """Collect frames for a new model; the present one stays in use until the new one is ready.

        A refit in progress is dropped: it was started by the engine, this by a person.
        """
        if self._is_comparing:
            raise CommandRefusedError(COMPARING)
        if self._is_refitting:
            self._discards_outcome = True
        if not self._discards_outcome:
            self._refuse_while_busy()
        self._begin_learning(keeps_zero=keeps_zero)
        self._refusal = ""

    def activate(self, model: MotionModel) -> None:
        """Use a stored model of this session after the reference was transferred to it."""
        self._refuse_other_calibration(model)
        mismatch = steps_mismatch(model, self.depth_steps)
        if mismatch is not None:
            raise mismatch
        self._refuse_while_busy()
        self._refusal, self._refits = "", None
        if self._active is not None:
            self._task = SwitchTask(model, self._settings, self._stages)
            return
        self._task = None
        self._start(SwitchJob(model=model, stages=self._stages.of_now()))

    def _change(self, *, is_position_new: bool = True) -> None:
        """Count a change of model or reference; the position is the same where the reference was transferred."""
        self._generation += 1
        if is_position_new:
            self._position_generation += 1

    def resume(self, model: MotionModel) -> None:
        """Start with a model of an earlier fraction; it is compared with the patient before the gate can be armed.

        Its reference is not transferred, as the patient's position may differ. Motion is relative to the first frame
        until an operator sets the reference.
        """
        self._refuse_other_calibration(model)
        self._refuse_while_busy()
        if model.surface_mm is None:
            raise ModelMismatchError("model", "of an older version", "one that stores its patient's surface")
        self._task, self._refits = None, None
        self._start(SwitchJob(model=model, stages=self._stages.of_now(), is_stored=True))

    def use(self, learned: Learned) -> None:
        """Use what another learner has learned from the same frames; learn nothing."""
        self._active, self._reference = learned.active, learned.reference
        self._reference_number, self._needs_reference = learned.reference_number, learned.needs_reference
        self._task, self._refits, self._patient_match = None, None, learned.patient_match
        self._change()

    @property
    def learned(self) -> Learned:
        """The model and the reference in use, for another learner."""
        return Learned(
            active=self._active,
            reference=self._reference,
            reference_number=self._reference_number,
            needs_reference=self._needs_reference,
            patient_match=self._patient_match,
        )

    def restart_after_disconnection(self) -> None:
        """Restart after the camera was disconnected: camera or patient may have moved.

        The model stays in use, is compared with the patient like a stored one, and an operator has to set the
        reference. Collected frames, a running fit and a waiting model are dropped. Without a model, training restarts.
        """
        if self._loses_request:
            self._emit(LearningEventKind.REFUSED, DROPPED, {"code": SourceAwayError.code})
            self._refusal, self._refused_us = DROPPED, self._now_us
        self._candidate, self._task = None, None
        self._discards_outcome = self._trainer.is_busy
        self._reference, self._is_reference_requested = None, False
        self._forget_positions()
        self._history.lose_camera()
        self._patient_match = None
        self._change()
        if self._active is None or self._active.model.surface_mm is None:
            self._active, self._is_comparing = None, False
            self._begin_learning()
            return
        self._refits = None
        self._needs_reference = True
        self._compare(self._active, may_repeat=True)
        self._emit(LearningEventKind.ZERO_NEEDED, "the camera was disconnected: set the reference before arming")

    @property
    def _loses_request(self) -> bool:
        """Whether a requested training or a waiting model is dropped; a comparison or first training just restarts."""
        is_fitted = self._trainer.is_busy and not self._discards_outcome
        is_gathered = self._task is not None and self._active is not None
        return self._candidate is not None or (not self._is_comparing and (is_fitted or is_gathered))

    def apply_model(self) -> None:
        """Switch to the waiting model; the caller has disarmed the gate. Raise CommandRefusedError if there is none."""
        if self._candidate is None:
            msg = "no new model waits to be applied"
            raise CommandRefusedError(msg)
        self._switch(self._candidate)

    def _refuse_other_calibration(self, model: MotionModel) -> None:
        if model.calibration_sha256 != self._calibration_sha256:
            bound = f"the session's calibration, {self._calibration_sha256[:12]}"
            raise ModelMismatchError("model.calibration_sha256", model.calibration_sha256[:12], bound)

    def _refuse_while_busy(self) -> None:
        if self._is_comparing:
            raise CommandRefusedError(COMPARING)
        if self._trainer.is_busy:
            raise CommandRefusedError(BUSY)

    # -- between and at frames ----------------------------------------------------------------------------------

    def collect(self, timestamp_us: int) -> None:
        """Between two frames: take the trainer's result, switch models if allowed, start a training that is due."""
        self._now_us = timestamp_us
        self._drop_late_request()
        self._follow_past()
        self._collect()
        if self._candidate is not None and not self._is_model_held:
            self._switch(self._candidate)
        self._retrain_if_due()

    def learn(self, frame: TrainingFrame) -> None:
        """Add a frame to the current task; start its job when the task is complete."""
        task = self._task
        if task is None or self._trainer.is_busy:
            return
        task.add(frame)
        if task.is_complete:
            self._task = None
            job = task.job(self._active)
            if isinstance(task, FitTask):
                job = StepsJob(job=job, steps=self.depth_steps)
            if self._active is None:
                job = PastBreathsJob(job=job, stretch=self._past.stretch, stages=self._stages.of_now())
            self._start(job)

    def _start(self, job: Callable[[], Outcome]) -> None:
        self._started_with = self._active
        self._trainer.start(job)
        self._collect()

    # -- refits to all of the session so far --------------------------------------------------------------------

    def is_kept(self, timestamp_us: int) -> bool:
        """Whether a frame of this time is kept: it has to be sampled as finely as a training frame."""
        return (self._refits is not None and self._refits.is_due(timestamp_us)) or self._is_past_due(timestamp_us)

    def _is_past_due(self, timestamp_us: int) -> bool:
        return (self._active is None or self._past_breaths is not None) and self._past.is_due(timestamp_us)

    def _begin_past(self, breaths: PastBreaths | None) -> None:
        """Follow the frames that arrived during the first fit; other models have none."""
        self._past_breaths = breaths
        if breaths is None:
            self._past.clear()
        self._follow_past()

    def _follow_past(self) -> None:
        """Follow some of those frames; from the last on, their positions are the ones that are proposed."""
        breaths = self._past_breaths
        if breaths is None or not breaths.follow(self._past.stretch, FOLLOWED_AT_ONCE):
            return
        self._proposals, self._past_breaths = breaths.proposals, None
        self._proposals.restart_breaths()
        self._past.clear()

    def keep(self, frame: TrainingFrame) -> None:
        """Keep a measured or training frame if it is due, and start a refit that has become due."""
        if self._is_past_due(frame.timestamp_us):
            self._past.add(frame)
        if self._refits is None or not self._refits.is_due(frame.timestamp_us):
            return
        self._refits.add(frame)
        is_free = not self._is_model_held and self._task is None and not self._trainer.is_busy
        job = self._refits.job(self._active) if is_free and self._active is not None else None
        if job is not None:
            self._emit(LearningEventKind.STARTED, "the model is refitted to the session so far")
            self._is_refitting = True
            self._start(StepsJob(job=job, steps=self.depth_steps))

    def keep_recording(self) -> None:
        """Keep frames of a whole recording, for `learned_from_recording`; refit nothing before its end."""
        self._refits = self._new_refits(is_survey=True)

    def learned_from_recording(self) -> Learned:
        """Return what was learned, with a model of the longest stretch without movement where that is worthwhile."""
        if self._refits is None or self._active is None:
            return self.learned
        return replace(self.learned, active=self._refits.of_longest(self._active) or self._active)

    def _retrain_if_due(self) -> None:
        interval_us = self._settings.retrain_interval_s * 1e6
        self._learned_us = min(self._learned_us, self._now_us)  # the device's clock may restart
        is_free = self._active is not None and self._task is None and not self._trainer.is_busy
        if interval_us > 0.0 and is_free and self._now_us - self._learned_us >= interval_us:
            self._begin_learning()
            self._emit(
                LearningEventKind.STARTED,
                "the retraining interval has passed",
                {"interval_s": self._settings.retrain_interval_s},
            )

    def _begin_learning(self, *, keeps_zero: bool = True) -> None:
        self._task = FitTask(self._settings, self._stages, self._calibration_sha256, keeps_zero=keeps_zero)
        self._past.clear()
        if self._refits is None or not self._refits.is_survey:
            self._refits = self._new_refits()

    def _new_refits(self, *, is_survey: bool = False) -> Refits:
        return Refits(self._settings, self._stages, self._calibration_sha256, is_survey=is_survey)

    def _collect(self) -> None:
        outcome = self._trainer.collect() if self._trainer.is_busy else None
        if outcome is None:
            return
        self._is_refitting = False
        started_with, self._started_with = self._started_with, None
        if self._discards_outcome:
            self._discards_outcome = False
            return
        match outcome:
            case Candidate():
                self._receive(outcome, started_with)
            case PatientMatch():
                self._receive_match(outcome)
            case ModelError():
                self._refuse(outcome)

    def _receive(self, candidate: Candidate, started_with: PreparedModel | None) -> None:
        self._learned_us = self._now_us
        if started_with is not self._active:  # cannot happen: models are not switched while the trainer is busy
            self._refuse(ModelError("another model is in use by now"))
            return
        if self._active is not None:
            self._emit(LearningEventKind.READY, "a new model is ready", transfer_figures(candidate, self._reference))
        self._candidate = candidate
        if not self._is_model_held:
            self._switch(candidate)

    def _switch(self, candidate: Candidate) -> None:
        previous_reference = self._reference
        figures = transfer_figures(candidate, previous_reference)
        self._candidate = None
        is_transferred = candidate.transfer is not None and previous_reference is not None
        if candidate.transfer is not None and previous_reference is not None:
            self._reference = candidate.transfer.applied(previous_reference)
            self._proposals.transfer(candidate.transfer)
            self._history.transfer(candidate.transfer)
            if self._requested_position is not None:
                self._requested_position = candidate.transfer.applied(self._requested_position)
        else:
            self._reference, self._needs_reference = None, True
            self._is_reference_requested = False
            self._forget_positions()
        self._active = candidate.active
        self._change(is_position_new=not is_transferred)
        self._refusal = ""
        self._emit(LearningEventKind.SWAPPED, "a new model is in use", figures)
        if not is_transferred:
            self._emit(LearningEventKind.ZERO_NEEDED, "a new model without a reference: set it before arming")
        self._begin_past(candidate.past_breaths)
        if candidate.is_stored:
            self._compare(candidate.active, may_repeat=True)

    def _compare(self, active: PreparedModel, *, may_repeat: bool) -> None:
        """Compare the model in use with the patient; a refusal is final unless the comparison ``may_repeat``."""
        self._is_comparing, self._may_compare_again = True, may_repeat
        self._task = CompareTask(active, self._limits, self._stages)

    def _receive_match(self, patient_match: PatientMatch) -> None:
        may_repeat = self._may_compare_again and patient_match.refusal is not None
        if patient_match.refusal is None and self._active is not None:
            patient_match = replace(patient_match, refusal=steps_mismatch(self._active.model, self.depth_steps))
        self._patient_match = patient_match
        self._is_comparing = False
        self._emit(
            LearningEventKind.COMPARED, "the stored model was compared with the patient", match_figures(patient_match)
        )
        if patient_match.refusal is None:
            return
        if may_repeat and self._active is not None:  # a hand in view costs no model
            self._compare(self._active, may_repeat=False)
        else:
            self._refuse(patient_match.refusal, drops_model=True)

    def _refuse(self, error: ModelError, *, drops_model: bool = False) -> None:
        """Report a refusal; without a model in use, restart the training."""
        bounds = {name: getattr(error, name, None) for name in ("field", "value", "bound")}
        self._emit(LearningEventKind.REFUSED, str(error), {"code": error.code, **bounds})
        self._refusal, self._refused_us = str(error), self._now_us
        self._learned_us = self._now_us
        if drops_model or self._is_comparing:
            self._active, self._reference, self._is_comparing = None, None, False
            self._is_reference_requested = False
            self._forget_positions()
            self._change()
        if self._active is None:
            self._begin_learning()

    def _emit(
        self,
        kind: LearningEventKind,
        detail: str,
        figures: Figures | None = None,
        first: FirstReference | None = None,
    ) -> None:
        notice = LearningEvent(kind=kind, detail=detail, timestamp_us=self._now_us, figures=figures or {}, first=first)
        self._notices.append(notice)


def _note(text: str, *, share: float) -> TrainingProgress:
    return TrainingProgress(frames=0, cycles=0, seconds=0.0, share=share, note=text)
