"""Manages the motion model and the reference: collects frames, starts fits, switches models between two frames.

Owned by the pipeline's thread, and separate from measuring: the frame path does not depend on how models are made. The
model's life is in :mod:`engine.motion.learning.lifecycle`, the reference in `reference`, refits in `refit`.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import NamedTuple

from engine.core.breath import Breath, SignalChoice
from engine.core.errors import CommandRefusedError
from engine.core.frames import FloatArray, Motion
from engine.core.learning_status import LearningEvent, LearningEventKind, LearningStatus, PatientMatch
from engine.core.motion_model import MotionModel
from engine.core.reference import ReferenceDistance, ReferenceMoment
from engine.core.sentences import say
from engine.core.signals import LearnedLevels, Ranges, ranges_of
from engine.motion.learning.learning_journal import LearningJournal
from engine.motion.learning.lifecycle import LearningSetup, ModelLifecycle
from engine.motion.learning.past_frames import PastFollower
from engine.motion.learning.prepared_model import PreparedModel, Reference
from engine.motion.learning.reference import PatientReference
from engine.motion.learning.reference_history import ReferenceHistory
from engine.motion.learning.refit import SessionRefits
from engine.motion.learning.tasks import Outcome
from engine.motion.learning.trainer import Trainer
from engine.motion.learning.training_set import TrainingFrame


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Learned:
    """A model, and the reference that motion was measured from; ``reference`` is None if nothing was measured."""

    active: PreparedModel | None
    reference: Reference | None
    reference_number: int
    needs_reference: bool
    patient_match: PatientMatch | None


class FrameNeeds(NamedTuple):
    """What learning needs of a frame.

    Attributes
    ----------
    active
        The model that the frame is measured with; None before the first.
    is_gathering
        Whether a training takes frames.
    takes_lost_frames
        Whether it also takes frames that the present model does not explain.
    is_fine
        Whether the frame is sampled as finely as training frames.
    """

    active: PreparedModel | None
    is_gathering: bool
    takes_lost_frames: bool
    is_fine: bool


class Learner:
    """The present model, its reference, and the next model in progress.

    Attributes
    ----------
    history
        Keeps the fraction's first reference, and the plan's position.
    journal
        Numbers that change with model and reference.
    """

    def __init__(self, setup: LearningSetup, trainer: Trainer[Outcome], history: ReferenceHistory) -> None:
        self.history, self.journal = history, LearningJournal()
        self._past = PastFollower(setup.stages.vertices)
        self.reference = PatientReference(history, self.journal, self._past)
        self.refits = SessionRefits(setup.settings, setup.stages, setup.calibration_sha256)
        self.models = ModelLifecycle(
            setup,
            trainer=trainer,
            journal=self.journal,
            reference=self.reference,
            past=self._past,
            refits=self.refits,
        )

    @property
    def active(self) -> PreparedModel | None:
        """The model in use, prepared for measuring."""
        return self.models.active

    @property
    def status(self) -> LearningStatus:
        """The model and the reference in use."""
        reference, active = self.reference, self.models.active
        return LearningStatus(
            model=None if active is None else active.model,
            model_shortcoming=self.models.shortcoming,
            model_generation=self.journal.generation,
            is_model_waiting=self.models.candidate is not None,
            has_reference=reference.is_set,
            reference_number=reference.number,
            reference_proposals=reference.proposed,
            reference_distance=reference.distance if reference.is_set else None,
            patient_match=self.models.patient_match,
            position_check=reference.position_check if reference.is_set else None,
            is_position_required=self.history.has_plan,
        )

    def learned_ranges(self, choices: Iterable[SignalChoice]) -> Ranges:
        """Return the range of each signal in the training relative to the reference; empty without a reference."""
        return ranges_of(self.learned_levels(choices))

    def learned_levels(self, choices: Iterable[SignalChoice]) -> LearnedLevels:
        """Return the levels of each signal in the training relative to the reference; empty without a reference."""
        return self.reference.levels(self.models.active, choices)

    def reference_distance(self, moment: ReferenceMoment) -> ReferenceDistance | None:
        """Return how far the position that would become the reference lies from the fraction's first; None without one.

        The present position is that of the newest frame.
        """
        active = self.models.active
        return None if active is None else self.reference.distance_at(active, moment)

    def take_notices(self) -> list[LearningEvent]:
        """Return the events since the last call."""
        return self.journal.take()

    # -- commands -----------------------------------------------------------------------------------------------

    def keep_model(self, *, is_kept: bool) -> None:
        """Set whether the present model must stay in use, because the gate is armed."""
        self.models.is_held = is_kept

    def set_reference(self, moment: ReferenceMoment = ReferenceMoment.NOW, *, most_mm: float | None = None) -> None:
        """Make the position at the last ends of exhale or inhale, or in the next measured frame, the reference.

        One that lies further than ``most_mm`` from the fraction's first, or at an unknown distance, is dropped when it
        is taken up; None accepts any.

        Raises
        ------
        CommandRefusedError
            There is no model yet, or fewer than two such breaths are known.
        """
        if self.models.active is None:
            msg = say("there is no motion model yet: a reference needs one")
            raise CommandRefusedError(msg)
        self.reference.request(moment, most_mm=most_mm)

    def retrain(self, *, keeps_reference: bool = True) -> None:
        """Collect frames for a new model; the present one stays in use until the new one is ready."""
        self.models.retrain(keeps_reference=keeps_reference)

    def activate(self, model: MotionModel) -> None:
        """Use a stored model of this session after the reference was transferred to it."""
        self.models.activate(model)

    def apply_model(self) -> None:
        """Switch to the waiting model; the caller has disarmed the gate. Raise CommandRefusedError if there is none."""
        if self.models.candidate is None:
            msg = say("no new model waits to be applied")
            raise CommandRefusedError(msg)
        self.models.switch(self.models.candidate)

    def restart_after_disconnection(self) -> None:
        """Restart after the camera was disconnected; an operator has to set the reference. See `ModelLifecycle`."""
        self.history.lose_camera()
        self.models.restart()

    def drop_cold_reference(self) -> None:
        """Drop the reference, which a cold camera measured; its distance from others is not known either."""
        if self.reference.current is None:
            return
        self.history.doubt_first()
        self.reference.drop()
        self.reference.is_needed = True
        self.journal.change()
        detail = say("the camera is warm now, and the reference was set while its readings drifted: set it again")
        self.journal.emit(LearningEventKind.ZERO_NEEDED, detail)

    def use(self, learned: Learned) -> None:
        """Use what another learner has learned from the same frames; learn nothing."""
        self.reference.current, self.reference.number = learned.reference, learned.reference_number
        self.reference.is_needed = learned.needs_reference
        self.models.use(learned.active, learned.patient_match)
        self.journal.change()

    @property
    def learned(self) -> Learned:
        """The model and the reference in use, for another learner."""
        return Learned(
            active=self.models.active,
            reference=self.reference.current,
            reference_number=self.reference.number,
            needs_reference=self.reference.is_needed,
            patient_match=self.models.patient_match,
        )

    # -- between and at frames ----------------------------------------------------------------------------------

    def begin_frame(self, timestamp_us: int) -> FrameNeeds:
        """Between two frames: take the trainer's result, switch models if allowed, start a training that is due.

        Return what learning needs of the next frame.
        """
        self.journal.now_us = timestamp_us
        self.reference.drop_late_request()
        if self._past.is_following:
            self.reference.use_past()
        self.models.begin_frame()
        return self.needs(timestamp_us)

    def needs(self, timestamp_us: int) -> FrameNeeds:
        """Return what learning needs of a frame of this time."""
        models = self.models
        is_gathering = models.is_gathering
        return FrameNeeds(
            active=models.active,
            is_gathering=is_gathering,
            takes_lost_frames=models.takes_lost_frames,
            is_fine=models.active is None or is_gathering or self._is_kept(timestamp_us),
        )

    def _is_kept(self, timestamp_us: int) -> bool:
        has_model = self.models.active is not None
        return self.refits.is_due(timestamp_us) or self._past.is_due(timestamp_us, has_model=has_model)

    def follow(self, coefficients: FloatArray, motion: Motion, breath: Breath, timestamp_us: int) -> None:
        """Add a measured frame to the positions that are proposed as the reference."""
        if self.models.active is None:
            return
        self.reference.follow(
            self.models.active,
            coefficients,
            motion,
            breath,
            timestamp_us,
            ranges=lambda: self.learned_ranges((breath.signal,)),
            is_armed=self.models.is_held,
        )

    def keep(self, timestamp_us: int, kept: Callable[[], TrainingFrame | None]) -> None:
        """Keep a measured or training frame if it is due, and start a refit that has become due."""
        frame = kept() if self._is_kept(timestamp_us) else None
        if frame is None:
            return
        self._past.keep(frame, has_model=self.models.active is not None)
        if self.refits.is_due(timestamp_us):
            self.refits.add(frame)
            self.models.refit_if_due()
