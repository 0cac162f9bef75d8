"""What the loop asks of the measuring, so that the loop can be tried on a pipeline that measures what it is told."""

from collections.abc import Iterable
from typing import Protocol

from engine.breath import SignalChoice
from engine.frames import Measurement, RgbdFrame
from engine.model import MotionModel
from engine.notices import LearningNotice
from engine.windows import Ranges


class FramePipeline(Protocol):
    """What the loop asks of the measuring; owned by the engine thread."""

    @property
    def model(self) -> MotionModel | None:
        """The motion model in use."""

    @property
    def model_shortcoming(self) -> str | None:
        """Why nobody may arm with this model, in a sentence for a person; None when it will do."""

    @property
    def model_generation(self) -> int:
        """Changes whenever the model or the reference does."""

    @property
    def has_reference(self) -> bool:
        """Whether motion has a zero."""

    @property
    def zero_number(self) -> int:
        """Counts the zeros that were set; a zero that is carried over to another model is the same one."""

    def learned_ranges(self, choices: Iterable[SignalChoice]) -> Ranges:
        """Return the range each signal had while the model was learned, against the present zero."""

    def measure(self, frame: RgbdFrame) -> Measurement:
        """Measure one frame; "cannot tell" is data, an exception is a bug."""

    def set_reference(self) -> None:
        """Make the present position the zero; raise a TidegateError where there is none."""

    def correct_baseline(self, choice: SignalChoice, by: float) -> None:
        """Tell drift of a signal against a level so much higher than the learned one [mm or l]."""

    @property
    def is_model_waiting(self) -> bool:
        """Whether a model is ready and waits for the gate to be disarmed."""

    def keep_model(self, *, is_kept: bool) -> None:
        """Say, before each frame, whether the present model must stay: an armed gate decides by it."""

    def retrain(self, *, keeps_zero: bool = True) -> None:
        """Gather frames and learn again."""

    def activate(self, model: MotionModel) -> None:
        """Measure with ``model`` as soon as the zero is carried over; raise ModelError if it does not fit."""

    def apply_model(self) -> None:
        """Let the model that waits take over now."""

    def camera_returned(self) -> None:
        """Hear that the camera was away: compare the model with the patient again; a person has to set the zero."""

    def take_notices(self) -> list[LearningNotice]:
        """Return what the learning has to tell since the last call."""
