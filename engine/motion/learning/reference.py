"""The reference, and who decides about it: requested, taken up, proposed, compared, transferred and dropped here alone.

The reference is the patient's position that motion counts from (:class:`Reference`). A person requests one: the
position of the next measured frame, or the mean of the last ends of exhale or inhale, which are proposed here. The next
measured frame takes it up. Until a person has set one, motion counts from the first measured frame, and the gate is not
armed.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

from engine.core.breath import Breath, SignalChoice
from engine.core.errors import CommandRefusedError
from engine.core.frames import FloatArray, Motion
from engine.core.learning_status import LearningEventKind
from engine.core.reference import ReferenceDistance, ReferenceMoment, ReferenceProposal
from engine.core.sentences import say
from engine.core.signals import LearnedLevels, Ranges
from engine.motion.learning.learning_journal import LearningJournal, distance_figures, position_figures
from engine.motion.learning.past_frames import PastFollower
from engine.motion.learning.prepared_model import PreparedModel, Reference, of_regions
from engine.motion.learning.reference_history import ReferenceHistory, learned_levels
from engine.motion.learning.reference_proposals import MAX_GAP_US, ReferenceProposals
from engine.motion.learning.reference_transfer import ReferenceTransfer

if TYPE_CHECKING:
    from engine.core.position_check import PositionCheck

FIRST = say("the first reference of this fraction: later ones are measured from it")
TOO_FEW_BREATHS = say(
    "fewer than two breaths are known since the patient lies here: wait until the patient has breathed"
)


class _Request(NamedTuple):
    """A requested reference; ``position`` is None for that of the next measured frame.

    One that lies further than ``most_mm`` from the fraction's first, or at an unknown distance, is dropped when it is
    taken up; None accepts any.
    """

    moment: ReferenceMoment
    position: Reference | None
    at_us: int
    most_mm: float | None


class _Newest(NamedTuple):
    """The newest measured frame: coefficients, shape (k + e,), and device time [us]."""

    active: PreparedModel
    coefficients: FloatArray
    motion: Motion
    at_us: int


class PatientReference:
    """The reference in use, what a person has requested, and what is proposed; owned by the pipeline's thread.

    Attributes
    ----------
    current
        What motion is measured from; None before the first measured frame of a model.
    is_needed
        Whether a person has to set the reference before the gate is armed.
    number
        Changes with every reference that is taken up.
    is_end_exhale
        Whether it was set to the mean of the last ends of exhale.
    distance, position_check
        Of the reference from the fraction's first one, and against the plan's position.
    proposed
        The positions that are proposed as the reference, with their distances.
    """

    def __init__(self, history: ReferenceHistory, journal: LearningJournal, past: PastFollower) -> None:
        self._history, self._journal, self._past = history, journal, past
        self._proposals = ReferenceProposals()
        self._request: _Request | None = None
        self._newest: _Newest | None = None
        self._proposed_for = -1
        self.current: Reference | None = None
        self.is_needed = False
        self.number = 0
        self.is_end_exhale = False
        self.distance: ReferenceDistance | None = None
        self.position_check: PositionCheck | None = None
        self.proposed: tuple[ReferenceProposal, ...] = ()

    @property
    def is_set(self) -> bool:
        """Whether a gate may be armed with it."""
        return self.current is not None and self._request is None and not self.is_needed

    @property
    def is_due(self) -> bool:
        """Whether the next measured frame becomes the reference."""
        return self.current is None or self._request is not None

    def request(self, moment: ReferenceMoment, *, most_mm: float | None) -> None:
        """Request the position at the last ends of exhale or inhale, or of the next measured frame.

        Raises
        ------
        CommandRefusedError
            Fewer than two such breaths are known.
        """
        now_us = self._journal.now_us
        position = None if moment is ReferenceMoment.NOW else self._at(moment, now_us)
        self._request = _Request(moment=moment, position=position, at_us=now_us, most_mm=most_mm)
        self._journal.change()

    def drop_late_request(self) -> None:
        """Drop a requested reference that no measured frame has taken up: the patient may lie elsewhere by now."""
        if self._request is None or 0 <= self._journal.now_us - self._request.at_us <= MAX_GAP_US:
            return
        self._request, self.is_needed = None, True
        self.forget_breaths()
        self._journal.change()
        detail = say("the reference was not set, because the patient was not measured for a second: set it again")
        self._journal.emit(LearningEventKind.ZERO_NEEDED, detail)

    def take_up(self, active: PreparedModel, present: Callable[[], Reference]) -> tuple[Reference, bool]:
        """Return the reference, and whether it was taken up now: a requested position, or the present one, if due."""
        request = self._request
        if self.current is not None and request is None:
            return self.current, False
        self.current = (None if request is None else request.position) or present()
        self.number += 1
        self.is_end_exhale = request is not None and request.moment is ReferenceMoment.END_EXHALE
        if request is not None:
            self._confirm(active, self.current, request)
        self._request = None
        return self.current, True

    def _confirm(self, active: PreparedModel, reference: Reference, request: _Request) -> None:
        """Accept a reference that a person confirmed, unless it lies further from the first than was allowed."""
        self.distance, first = self._history.confirm(active, reference, request.moment)
        self.position_check = self._history.position(reference, request.moment)
        self.is_needed = first is None and not self.distance.is_within(request.most_mm)
        if self.is_needed:
            detail = say("the reference was dropped, because it lies {text}: set it again", text=self.distance.text)
            self._journal.emit(LearningEventKind.ZERO_NEEDED, detail, distance_figures(self.distance))
            return
        detail = FIRST if first is not None else say("the reference lies {text}", text=self.distance.text)
        if math.isfinite(reference.uncertainty_mm):
            detail = say(
                "{detail}; its uncertainty is {uncertainty_mm:.2f} mm",
                detail=detail,
                uncertainty_mm=reference.uncertainty_mm,
            )
        figures = {**distance_figures(self.distance), **position_figures(self.position_check)}
        self._journal.emit(LearningEventKind.REFERENCE_SET, detail, figures, first)

    def transfer(self, transfer: ReferenceTransfer | None) -> bool:
        """Take the reference over to another model, or drop it where that cannot be; return whether it was taken."""
        if transfer is None or self.current is None:
            self.drop()
            self.is_needed = True
            return False
        self.current = transfer.applied(self.current)
        self._proposals.transfer(transfer)
        self._history.transfer(transfer)
        if self._request is not None and self._request.position is not None:
            self._request = self._request._replace(position=transfer.applied(self._request.position))
        return True

    def drop(self) -> None:
        """Drop the reference, the request and the positions of breaths."""
        self.current, self._request = None, None
        self.forget_breaths()

    def forget_breaths(self) -> None:
        """Forget the positions of breaths: the patient or the camera may be elsewhere."""
        self._proposals.clear()
        self._past.forget()
        self.proposed = ()

    def use_past(self) -> None:
        """Propose the positions of frames from before the first model, once all of them are followed."""
        proposals = self._past.follow()
        if proposals is not None:
            self._proposals = proposals
            self._proposals.restart_breaths()

    def move_levels(self, before: Motion, now: Motion) -> None:
        """Measure the proposed levels from a new reference: the motion of one frame from the old and the new one."""
        self._proposals.move(before, now)

    @property
    def levels_from(self) -> Reference | None:
        """The reference of the levels from before the model, until `move_levels`; None where there are none."""
        return self._proposals.measured_from

    def levels(self, active: PreparedModel | None, choices: Iterable[SignalChoice]) -> LearnedLevels:
        """Return the levels of each signal in the training relative to the reference; empty without a reference."""
        if active is None or self.current is None or self._request is not None:
            return {}
        return learned_levels(active, self.current, choices)

    # -- positions of the last breaths ------------------------------------------------------------------------------

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
                self._compared(one, active, self._at(one.moment, timestamp_us), is_armed=is_armed)
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

    def _at(self, moment: ReferenceMoment, now_us: int) -> Reference:
        """Return the position of a moment of the breath; raise CommandRefusedError where too few breaths are known."""
        position = self._proposals.position(moment, now_us)
        if position is None:
            raise CommandRefusedError(TOO_FEW_BREATHS)
        return position

    def distance_at(self, active: PreparedModel, moment: ReferenceMoment) -> ReferenceDistance | None:
        """Return how far the position that would become the reference lies from the fraction's first; None without one.

        The present position is that of the newest frame.
        """
        now_us = self._journal.now_us
        position = self._now(active) if moment is ReferenceMoment.NOW else self._at(moment, now_us)
        return self._history.distance(active, position)

    def _now(self, active: PreparedModel) -> Reference | None:
        newest = self._newest
        if newest is None or newest.active is not active or not 0 <= self._journal.now_us - newest.at_us <= MAX_GAP_US:
            return None
        return newest.active.reference(newest.coefficients, newest.motion.surface_mm, of_regions(newest.motion.seen))
