"""A trainer behind the input tap: the frame at which a result arrives depends on a thread, the result does not."""

from collections.abc import Callable
from typing import Generic, TypeVar

from engine.core.errors import ModelError
from engine.core.input_tap import InputKind, InputTap
from engine.motion.learning.trainer import Trainer

T = TypeVar("T")


class TappedTrainer(Generic[T]):
    """Wraps a trainer, and has the tap observe when a result arrives."""

    def __init__(self, trainer: Trainer[T], tap: InputTap) -> None:
        self._trainer, self._tap = trainer, tap

    def start(self, job: Callable[[], T]) -> None:
        """Begin a job."""
        self._trainer.start(job)

    @property
    def is_busy(self) -> bool:
        """Whether a job was started and its result not yet collected."""
        return self._trainer.is_busy

    def collect(self) -> T | ModelError | None:
        """Return a finished job's result or failure once, without waiting."""
        return self._tap.observe(InputKind.TRAINED, self._trainer.collect)
