"""What is learned, and what counts as zero: gathers frames, has models fitted, swaps them between two frames.

Owned by the pipeline's thread. Kept apart from the measuring: a frame's way does not know how models come about. The
present model measures on until another is ready; while an armed gate decides by it, the other waits.
"""

from collections.abc import Iterable
from dataclasses import replace

from engine.active_model import ActiveModel, Reference
from engine.breath import SignalChoice
from engine.errands import Candidate, Errand, Handover, Learning, LearningStages, Look, Outcome, quality_figures
from engine.errors import CommandRefusedError, ModelError, ModelMismatchError, SourceAwayError
from engine.frames import FloatArray, TrainingProgress
from engine.gathering import GatheredFrame
from engine.learned_range import learned_ranges
from engine.likeness import Likeness, LikenessLimits
from engine.model import MotionModel
from engine.notices import Figures, LearningNotice, NoticeKind
from engine.training import Trainer, TrainingSettings
from engine.windows import Ranges

REFUSAL_SHOWN_S = 30.0
"""How long a refusal stays on show where the model before it measures on."""

BUSY = "a model is being fitted already"
DROPPED = "what was being learned, or waited to take over, was dropped: the camera was away"
ON_TRIAL = "the stored model is still being compared with the patient: wait a few seconds"


class Learner:
    """The present model and its zero, and the next model on its way."""

    def __init__(
        self,
        *,
        calibration_sha256: str,
        settings: TrainingSettings,
        likeness: LikenessLimits,
        stages: LearningStages,
        trainer: Trainer[Outcome],
    ) -> None:
        self._calibration_sha256 = calibration_sha256
        self._settings, self._limits = settings, likeness
        self._stages = stages
        self._trainer = trainer
        self._errand: Errand | None = self._learning()
        self._candidate: Candidate | None = None
        self._active: ActiveModel | None = None
        self._reference: Reference | None = None
        self._is_reference_wanted = False
        self._needs_zero = False
        self._zero_number = 0
        self._is_kept = False
        self._is_on_trial = False
        self._is_outcome_unwanted = False
        self._likeness: Likeness | None = None
        self._generation = 0
        self._now_us = 0
        self._learned_us = 0
        self._refusal = ""
        self._refused_us = 0
        self._notices: list[LearningNotice] = []

    @property
    def active(self) -> ActiveModel | None:
        """The model frames are measured with now, made ready."""
        return self._active

    @property
    def shortcoming(self) -> str | None:
        """Why nobody may arm with the present model; None when it will do, or when there is none."""
        if self._active is None:
            return None
        if self._is_on_trial:
            return ON_TRIAL
        cycles, needed = self._active.model.cycles, self._settings.min_cycles
        if cycles >= needed:
            return None
        return (
            f"the motion model was learned from {cycles} complete breathing cycles and {needed} are needed: "
            "learn again while the patient breathes calmly"
        )

    @property
    def likeness(self) -> Likeness | None:
        """How far today's patient is from the stored model that was begun with; None without one, or not known yet."""
        return self._likeness

    @property
    def has_reference(self) -> bool:
        """Whether there is a zero that somebody may arm with."""
        return self._reference is not None and not self._is_reference_wanted and not self._needs_zero

    @property
    def is_zero_due(self) -> bool:
        """Whether the next measured frame becomes the zero."""
        return self._reference is None or self._is_reference_wanted

    @property
    def generation(self) -> int:
        """Changes whenever the model or the reference did: what was armed before is armed no more."""
        return self._generation

    @property
    def is_gathering(self) -> bool:
        """Whether frames are wanted."""
        return self._errand is not None

    @property
    def takes_lost_frames(self) -> bool:
        """Whether frames are wanted that the present model does not measure."""
        return self._active is None or (self._errand is not None and not self._errand.needs_measured)

    @property
    def is_model_waiting(self) -> bool:
        """Whether a model is ready and waits for the gate to be disarmed."""
        return self._candidate is not None

    @property
    def progress(self) -> TrainingProgress | None:
        """How far the learning has come; None while nothing is being learned, nor was refused of late."""
        if self._errand is not None:
            progress = self._errand.progress
            return replace(progress, note=self._refusal) if self._refusal and not progress.note else progress
        if self._trainer.is_busy:
            return _note("fitting the model", share=1.0)
        if self._candidate is not None:
            return _note("a new model is ready: it takes over when the gate is disarmed", share=1.0)
        if self._refusal and self._now_us - self._refused_us <= REFUSAL_SHOWN_S * 1e6:
            return _note(self._refusal, share=0.0)
        return None

    def take_notices(self) -> list[LearningNotice]:
        """Return what has happened since the last call."""
        notices, self._notices = self._notices, []
        return notices

    def keep_model(self, *, is_kept: bool) -> None:
        """Say whether the present model must stay: a gate that is armed decides by it."""
        self._is_kept = is_kept

    # -- zero ---------------------------------------------------------------------------------------------------

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
            self._zero_number += 1
            self._needs_zero = self._needs_zero and not self._is_reference_wanted
            self._is_reference_wanted = False
        return self._reference

    @property
    def zero_number(self) -> int:
        """Counts the zeros that were set; one that is carried over to another model is the same."""
        return self._zero_number

    def learned_ranges(self, choices: Iterable[SignalChoice]) -> Ranges:
        """Return the range each signal had in the training, against the zero; empty before there is one."""
        if self._active is None or self._reference is None or self._is_reference_wanted:
            return {}
        return learned_ranges(self._active, self._reference, choices)

    # -- commands -----------------------------------------------------------------------------------------------

    def retrain(self, *, keeps_zero: bool = True) -> None:
        """Gather frames for a new model; the present one measures on until the new one is ready."""
        self._refuse_while_occupied()
        self._errand = self._learning(keeps_zero=keeps_zero)
        self._refusal = ""

    def activate(self, model: MotionModel) -> None:
        """Measure with a known model of this patient as soon as the zero is carried over to it."""
        self._refuse_other_calibration(model)
        self._refuse_while_occupied()
        self._refusal = ""
        if self._active is not None:
            self._errand = Handover(model, self._settings, self._stages)
            return
        self._errand = None
        self._trainer.start(lambda: Candidate(active=self._stages.prepare(model)))
        self._collect()

    def resume(self, model: MotionModel) -> None:
        """Begin with a model of an earlier fraction; it is compared with the patient before anybody may arm.

        Its zero is not carried over: what was zero then says nothing of today. Motion is shown against the first frame
        until a person sets the zero.
        """
        self._refuse_other_calibration(model)
        self._refuse_while_occupied()
        if model.surface_mm is None:
            raise ModelMismatchError("model", "of an older version", "one that says where its patient lay")
        self._errand = None
        self._trainer.start(lambda: Candidate(active=self._stages.prepare(model), needs_zero=True, is_stored=True))
        self._collect()

    def doubt(self) -> None:
        """Begin anew after a while without a camera, which may hang elsewhere now, over a patient who may have moved.

        The model measures on, is compared with the patient as a stored one is, and a person has to set the zero. What
        was gathered, fitted or waiting is dropped. Without a model the gathering begins anew.
        """
        if self._is_something_lost:
            self._tell(NoticeKind.REFUSED, DROPPED, {"code": SourceAwayError.code})
            self._refusal, self._refused_us = DROPPED, self._now_us
        self._candidate, self._errand = None, None
        self._is_outcome_unwanted = self._trainer.is_busy
        self._reference, self._is_reference_wanted = None, False
        self._likeness = None
        self._generation += 1
        if self._active is None or self._active.model.surface_mm is None:
            self._active, self._is_on_trial = None, False
            self._errand = self._learning()
            return
        self._needs_zero, self._is_on_trial = True, True
        self._errand = Look(self._active, self._limits, self._stages)
        self._tell(NoticeKind.ZERO_NEEDED, "the camera was away: a person has to set the zero before arming")

    @property
    def _is_something_lost(self) -> bool:
        """Whether somebody waits for what is dropped: not for a comparison nor a first gathering, which begin anew."""
        is_fitted = self._trainer.is_busy and not self._is_outcome_unwanted
        is_gathered = self._errand is not None and self._active is not None
        return self._candidate is not None or (not self._is_on_trial and (is_fitted or is_gathered))

    def apply_model(self) -> None:
        """Swap to the model that waits, now; the caller has disarmed."""
        if self._candidate is None:
            msg = "no new model waits to be applied"
            raise CommandRefusedError(msg)
        self._swap(self._candidate)

    def _refuse_other_calibration(self, model: MotionModel) -> None:
        if model.calibration_sha256 != self._calibration_sha256:
            bound = f"the session's calibration, {self._calibration_sha256[:12]}"
            raise ModelMismatchError("model.calibration_sha256", model.calibration_sha256[:12], bound)

    def _refuse_while_occupied(self) -> None:
        if self._is_on_trial:
            raise CommandRefusedError(ON_TRIAL)
        if self._trainer.is_busy:
            raise CommandRefusedError(BUSY)

    # -- between and at frames ----------------------------------------------------------------------------------

    def collect(self, timestamp_us: int) -> None:
        """Between two frames: take what the trainer has finished, swap if that may be, and begin what is due."""
        self._now_us = timestamp_us
        self._collect()
        if self._candidate is not None and not self._is_kept:
            self._swap(self._candidate)
        self._begin_if_due()

    def learn(self, frame: GatheredFrame) -> None:
        """Take a frame for what is being learned; have it worked on when there are enough."""
        errand = self._errand
        if errand is None or self._trainer.is_busy:
            return
        errand.add(frame)
        if errand.is_complete:
            self._errand = None
            self._trainer.start(errand.job(self._active))
            self._collect()

    def _begin_if_due(self) -> None:
        interval_us = self._settings.retrain_interval_s * 1e6
        self._learned_us = min(self._learned_us, self._now_us)  # the device's clock may begin anew
        is_free = self._active is not None and self._errand is None and not self._trainer.is_busy
        if interval_us > 0.0 and is_free and self._now_us - self._learned_us >= interval_us:
            self._errand = self._learning()
            self._tell(NoticeKind.STARTED, "time for another model", {"interval_s": self._settings.retrain_interval_s})

    def _learning(self, *, keeps_zero: bool = True) -> Learning:
        return Learning(self._settings, self._stages, self._calibration_sha256, keeps_zero=keeps_zero)

    def _collect(self) -> None:
        outcome = self._trainer.collect() if self._trainer.is_busy else None
        if outcome is not None and self._is_outcome_unwanted:
            self._is_outcome_unwanted = False
            return
        match outcome:
            case Candidate():
                self._receive(outcome)
            case Likeness():
                self._receive_likeness(outcome)
            case ModelError():
                self._refuse(outcome)

    def _receive(self, candidate: Candidate) -> None:
        self._learned_us = self._now_us
        if candidate.before is not self._active:  # cannot be: nothing takes over while the trainer is busy
            self._refuse(ModelError("another model took over meanwhile"))
            return
        if candidate.before is not None:
            self._tell(NoticeKind.READY, "a model is ready to take over", _carry_figures(candidate, self._reference))
        self._candidate = candidate
        if not self._is_kept:
            self._swap(candidate)

    def _swap(self, candidate: Candidate) -> None:
        zero = self._reference
        figures = _carry_figures(candidate, zero)
        self._candidate = None
        if candidate.carry is not None and zero is not None:
            self._reference = candidate.carry.applied(zero)
        elif candidate.needs_zero:
            self._reference, self._needs_zero = None, True
        self._active = candidate.active
        self._generation += 1
        self._refusal = ""
        self._tell(NoticeKind.SWAPPED, "a model took over", figures)
        if candidate.needs_zero:
            self._tell(NoticeKind.ZERO_NEEDED, "the zero is not carried over: a person has to set it before arming")
        if candidate.is_stored:
            self._is_on_trial = True
            self._errand = Look(candidate.active, self._limits, self._stages)

    def _receive_likeness(self, likeness: Likeness) -> None:
        self._likeness = likeness
        self._is_on_trial = False
        self._tell(NoticeKind.COMPARED, "the stored model was compared with the patient", _likeness_figures(likeness))
        if likeness.refusal is not None:
            self._refuse(likeness.refusal, drops_model=True)

    def _refuse(self, error: ModelError, *, drops_model: bool = False) -> None:
        """Tell of a refusal; begin anew where there is no model to measure with."""
        bounds = {name: getattr(error, name, None) for name in ("field", "value", "bound")}
        self._tell(NoticeKind.REFUSED, str(error), {"code": error.code, **bounds})
        self._refusal, self._refused_us = str(error), self._now_us
        self._learned_us = self._now_us
        if drops_model or self._is_on_trial:
            self._active, self._reference, self._is_on_trial = None, None, False
            self._is_reference_wanted = False
            self._generation += 1
        if self._active is None:
            self._errand = self._learning()

    def _tell(self, kind: NoticeKind, detail: str, figures: Figures | None = None) -> None:
        notice = LearningNotice(kind=kind, detail=detail, timestamp_us=self._now_us, figures=figures or {})
        self._notices.append(notice)


def _note(text: str, *, share: float) -> TrainingProgress:
    return TrainingProgress(frames=0, cycles=0, seconds=0.0, share=share, note=text)


def _carry_figures(candidate: Candidate, zero: Reference | None) -> Figures:
    figures = dict(quality_figures(candidate.active.model))
    carry = candidate.carry
    if carry is not None:
        figures |= {"correction_mm": round(carry.correction_mm, 4), "carry_frames": carry.frames}
        figures |= {"volume_correction_l": round(carry.volume_l, 6)}
        if zero is not None:
            zero_mm = float(zero.regions_mm[candidate.active.regions.cells])
            figures |= {"zero_before_mm": round(zero_mm, 4), "zero_after_mm": round(zero_mm + carry.whole_mm, 4)}
    return figures


def _likeness_figures(likeness: Likeness) -> Figures:
    return {
        "frames": likeness.frames,
        "explained_share": round(likeness.explained_share, 3),
        "residual_mm": None if likeness.residual_mm is None else round(likeness.residual_mm, 3),
        **{f"shift_{axis}_mm": round(value, 2) for axis, value in zip("xyz", likeness.shift_mm, strict=True)},
        "tilt_deg": round(likeness.tilt_deg, 3),
        "shape_mm": round(likeness.shape_mm, 3),
        "is_accepted": likeness.refusal is None,
    }
