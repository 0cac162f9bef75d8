"""The positions of the last breaths: which are proposed as the reference, and how far they lie from the first.

Those of the training's frames are followed behind the first fit; see :mod:`engine.motion.learning.past_frames`.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from engine.core.breath import Breath
from engine.core.errors import CommandRefusedError
from engine.core.frames import FloatArray, Motion
from engine.core.reference import ReferenceDistance, ReferenceMoment, ReferenceProposal
from engine.core.sentences import say
from engine.core.signals import Ranges
from engine.motion.learning.learning_journal import LearningJournal
from engine.motion.learning.past_frames import FOLLOWED_AT_ONCE, PastBreaths, PastFrames, Stretch
from engine.motion.learning.prepared_model import PreparedModel, Reference
from engine.motion.learning.reference_history import ReferenceHistory
from engine.motion.learning.reference_proposals import MAX_GAP_US, ReferenceProposals
from engine.motion.learning.reference_transfer import ReferenceTransfer
from engine.motion.learning.seen_shares import of_regions
from engine.motion.learning.training_set import TrainingFrame, Vertices

TOO_FEW_BREATHS = say(
    "fewer than two breaths are known since the patient lies here: wait until the patient has breathed"
)


class _Newest(NamedTuple):
    """The newest measured frame: coefficients, shape (k + e,), and device time [us]."""

    active: PreparedModel
    coefficients: FloatArray
    motion: Motion
    at_us: int


class ReferencePositions:
    """Follows the measured frames; owned by the pipeline's thread.

    Attributes
    ----------
    proposed
        The positions that are proposed as the reference, with their distances.
    """

    def __init__(self, history: ReferenceHistory, journal: LearningJournal, vertices: Vertices) -> None:
        self._history, self._journal = history, journal
        self._proposals = ReferenceProposals()
        self._past = PastFrames(vertices)
        self._past_breaths: PastBreaths | None = None
        self._newest: _Newest | None = None
        self.proposed: tuple[ReferenceProposal, ...] = ()
        self._proposed_for = -1

    def follow(
        self,
        active: PreparedModel,
        coefficients: FloatArray,
        motion: Motion,
        breath: Breath,
        timestamp_us: int,
        *,
        ranges: Callable[[], Ranges],
        is_armed: bool,
    ) -> None:
        """Add a measured frame; ``ranges`` are those of the breath's signal, for the levels of proposals."""
        is_model_new = self._newest is not None and self._newest.active is not active
        self._newest = _Newest(active, coefficients, motion, timestamp_us)
        is_new = self._proposals.follow(active, coefficients, motion, breath, timestamp_us)
        if is_model_new:  # the first frame of a model has enough to do: the next one compares
            self._proposed_for = -1
        elif is_new or self._proposed_for != self._journal.generation:
            self._proposed_for = self._journal.generation
            self.proposed = tuple(
                self._compared(one, active, self.at(one.moment, timestamp_us), is_armed=is_armed)
                for one in self._proposals.proposals(ranges(), timestamp_us)
            )

    def _compared(
        self, one: ReferenceProposal, active: PreparedModel, position: Reference, *, is_armed: bool
    ) -> ReferenceProposal:
        """Return a proposal with its distance from the fraction's first reference, and its place against the plan's.

        The latter takes milliseconds: it is left out while the gate is armed, and for the end of inhale.
        """
        is_compared = not is_armed and one.moment is ReferenceMoment.END_EXHALE
        return replace(
            one,
            distance=self._history.distance(active, position),
            position_check=self._history.position(position, one.moment) if is_compared else None,
        )

    def at(self, moment: ReferenceMoment, now_us: int) -> Reference:
        """Return the position of a moment of the breath; raise CommandRefusedError where too few breaths are known."""
        position = self._proposals.position(moment, now_us)
        if position is None:
            raise CommandRefusedError(TOO_FEW_BREATHS)
        return position

    def distance(self, active: PreparedModel, moment: ReferenceMoment) -> ReferenceDistance | None:
        """Return how far the position that would become the reference lies from the fraction's first; None without one.

        The present position is that of the newest frame.
        """
        now_us = self._journal.now_us
        position = self._now(active) if moment is ReferenceMoment.NOW else self.at(moment, now_us)
        return self._history.distance(active, position)

    def _now(self, active: PreparedModel) -> Reference | None:
        newest = self._newest
        if newest is None or newest.active is not active or not 0 <= self._journal.now_us - newest.at_us <= MAX_GAP_US:
            return None
        return newest.active.reference(newest.coefficients, newest.motion.surface_mm, of_regions(newest.motion.seen))

    @property
    def levels_from(self) -> Reference | None:
        """The reference of the levels from before the model, until `move_levels`; None where there are none."""
        return self._proposals.measured_from

    def move_levels(self, before: Motion, now: Motion) -> None:
        """Measure the proposed levels from a new reference: the motion of one frame from the old and the new one."""
        self._proposals.move(before, now)

    def transfer(self, transfer: ReferenceTransfer) -> None:
        """Transfer the positions to another model, as the reference in use is."""
        self._proposals.transfer(transfer)
        self._history.transfer(transfer)

    def forget(self) -> None:
        """Forget them: the patient or the camera may be elsewhere."""
        self._proposals.clear()
        self._past_breaths = None
        self.proposed = ()

    # -- frames from before the first model -----------------------------------------------------------------------

    @property
    def past_stretch(self) -> Stretch:
        """The frames from before the first model."""
        return self._past.stretch

    def clear_past(self) -> None:
        """Drop those frames."""
        self._past.clear()

    def is_past_due(self, timestamp_us: int, *, has_model: bool) -> bool:
        """Whether a frame of this time is kept: without a model, and until those of the first fit are followed."""
        return (not has_model or self._past_breaths is not None) and self._past.is_due(timestamp_us)

    def keep_past(self, frame: TrainingFrame, *, has_model: bool) -> None:
        """Keep a frame that is due."""
        if self.is_past_due(frame.timestamp_us, has_model=has_model):
            self._past.add(frame)

    def begin_past(self, breaths: PastBreaths | None) -> None:
        """Follow the frames that arrived during the first fit; other models have none."""
        self._past_breaths = breaths
        if breaths is None:
            self._past.clear()
        self.follow_past()

    def follow_past(self) -> None:
        """Follow some of those frames; from the last on, their positions are the ones that are proposed."""
        breaths = self._past_breaths
        if breaths is None or not breaths.follow(self._past.stretch, FOLLOWED_AT_ONCE):
            return
        self._proposals, self._past_breaths = breaths.proposals, None
        self._proposals.restart_breaths()
        self._past.clear()
