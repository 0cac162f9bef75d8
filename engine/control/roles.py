"""The two roles that the loop needs filled: a measurer of frames, and a learner of motion models.

:class:`engine.motion.pipeline.Pipeline` and its learner fill them; tests fill them with scripted ones. Both are owned
by the engine thread.
"""

from collections.abc import Iterable
from typing import Protocol

from engine.core.breath import SignalChoice
from engine.core.frames import Measurement, RgbdFrame
from engine.core.learning_status import LearningEvent, LearningStatus
from engine.core.motion_model import MotionModel
from engine.core.reference import ReferenceDistance, ReferenceMoment
from engine.core.signals import LearnedLevels, Ranges


class Measurer(Protocol):
    """Measures frames."""

    def measure(self, frame: RgbdFrame) -> Measurement:
        """Measure one frame; a frame that cannot be measured is a value (lost), an exception is a bug."""

    def correct_baseline(self, choice: SignalChoice, by: float) -> None:
        """Count the drift of a signal from a level that is ``by`` higher than the learned one [mm or l]."""

    def camera_warmed(self) -> None:
        """Drop the reference, which was set while the camera's readings drifted. A person has to set it again."""

    def camera_returned(self) -> None:
        """Drop what was known of the patient's position: the camera was away. A person has to set the reference."""


class Learner(Protocol):
    """Learns motion models and owns the reference."""

    @property
    def status(self) -> LearningStatus:
        """The model and the reference in use."""

    def learned_ranges(self, choices: Iterable[SignalChoice]) -> Ranges:
        """Return each signal's range in the training, against the present reference; empty where there is none."""

    def reference_distance(self, moment: ReferenceMoment) -> ReferenceDistance | None:
        """Return how far the position that would become the reference lies from the fraction's first; None without one.

        Raises
        ------
        CommandRefusedError
            No such position is known.
        """

    def learned_levels(self, choices: Iterable[SignalChoice]) -> LearnedLevels:
        """Return each signal's levels in the training, against the present reference; empty where there is none."""

    def set_reference(self, moment: ReferenceMoment = ReferenceMoment.NOW, *, most_mm: float | None = None) -> None:
        """Make the proposed position, or that of the next measured frame, the reference.

        It is dropped when it is taken up where it lies further than ``most_mm`` from the fraction's first reference, or
        at an unknown distance; None accepts any.

        Raises
        ------
        TidegateError
            There is no model, or no such position is known.
        """

    def keep_model(self, *, is_kept: bool) -> None:
        """Set, before each frame, whether the present model must stay: an armed gate decides by it."""

    def retrain(self, *, keeps_reference: bool = True) -> None:
        """Gather frames and learn again; ``keeps_reference`` transfers the reference to the new model."""

    def activate(self, model: MotionModel) -> None:
        """Measure with ``model`` once the reference is transferred to it; raise ModelError if it does not fit."""

    def apply_model(self) -> None:
        """Switch to the model that waits; raise CommandRefusedError if none does."""

    def take_notices(self) -> list[LearningEvent]:
        """Return the learning events since the last call."""
