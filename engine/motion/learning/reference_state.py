"""The reference in use: requested by a person, taken up by the next measured frame, transferred to other models.

Until a person has set one, motion is relative to the first measured frame, and the gate is not armed.
"""

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, NamedTuple

from engine.core.breath import SignalChoice
from engine.core.learning_status import LearningEventKind
from engine.core.reference import ReferenceMoment
from engine.core.sentences import say
from engine.core.signals import LearnedLevels, Ranges
from engine.motion.learning.learning_journal import LearningJournal, distance_figures, position_figures
from engine.motion.learning.prepared_model import PreparedModel, Reference
from engine.motion.learning.reference_history import ReferenceHistory, learned_levels, learned_ranges
from engine.motion.learning.reference_positions import ReferencePositions
from engine.motion.learning.reference_proposals import MAX_GAP_US
from engine.motion.learning.reference_transfer import ReferenceTransfer

if TYPE_CHECKING:
    from engine.core.position_check import PositionCheck
    from engine.core.reference import ReferenceDistance

FIRST = say("the first reference of this fraction: later ones are measured from it")


class _Request(NamedTuple):
    """A requested reference; ``position`` is None for that of the next measured frame.

    One that lies further than ``most_mm`` from the fraction's first, or at an unknown distance, is dropped when it is
    taken up; None accepts any.
    """

    moment: ReferenceMoment
    position: Reference | None
    at_us: int
    most_mm: float | None


class ReferenceState:
    """The reference and what a person has requested; owned by the pipeline's thread.

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
    """

    def __init__(self, history: ReferenceHistory, journal: LearningJournal, positions: ReferencePositions) -> None:
        self._history, self._journal, self._positions = history, journal, positions
        self._request: _Request | None = None
        self.current: Reference | None = None
        self.is_needed = False
        self.number = 0
        self.is_end_exhale = False
        self.distance: ReferenceDistance | None = None
        self.position_check: PositionCheck | None = None

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
        position = None if moment is ReferenceMoment.NOW else self._positions.at(moment, now_us)
        self._request = _Request(moment=moment, position=position, at_us=now_us, most_mm=most_mm)
        self._journal.change()

    def drop_late_request(self) -> None:
        """Drop a requested reference that no measured frame has taken up: the patient may lie elsewhere by now."""
        if self._request is None or 0 <= self._journal.now_us - self._request.at_us <= MAX_GAP_US:
            return
        self._request, self.is_needed = None, True
        self._positions.forget()
        self._journal.change()
        detail = say("the reference was not set, because the patient was not measured for a second: set it again")
        self._journal.emit(LearningEventKind.ZERO_NEEDED, detail)

    def take_up(self, active: PreparedModel, present: Callable[[], Reference]) -> Reference:
        """Return the reference; a requested position, or the present one, becomes it if it is due."""
        if self.current is not None and self._request is None:
            return self.current
        request = self._request
        self.current = (None if request is None else request.position) or present()
        self.number += 1
        self.is_end_exhale = request is not None and request.moment is ReferenceMoment.END_EXHALE
        if request is not None:
            self._confirm(active, self.current, request)
        self._request = None
        return self.current

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
        figures = {**distance_figures(self.distance), **position_figures(self.position_check)}
        self._journal.emit(LearningEventKind.REFERENCE_SET, detail, figures, first)

    def transfer(self, transfer: ReferenceTransfer | None) -> bool:
        """Take the reference over to another model, or drop it where that cannot be; return whether it was taken."""
        if transfer is None or self.current is None:
            self.drop()
            self.is_needed = True
            return False
        self.current = transfer.applied(self.current)
        self._positions.transfer(transfer)
        if self._request is not None and self._request.position is not None:
            self._request = self._request._replace(position=transfer.applied(self._request.position))
        return True

    def drop(self) -> None:
        """Drop the reference, the request and the positions of breaths."""
        self.current, self._request = None, None
        self._positions.forget()

    def ranges(self, active: PreparedModel | None, choices: Iterable[SignalChoice]) -> Ranges:
        """Return the range of each signal in the training relative to the reference; empty without a reference."""
        if active is None or self.current is None or self._request is not None:
            return {}
        return learned_ranges(active, self.current, choices)

    def levels(self, active: PreparedModel | None, choices: Iterable[SignalChoice]) -> LearnedLevels:
        """Return the levels of each signal in the training relative to the reference; empty without a reference."""
        if active is None or self.current is None or self._request is not None:
            return {}
        return learned_levels(active, self.current, choices)
