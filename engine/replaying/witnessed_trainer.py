"""A trainer whose results are heard: which frame they come at hangs on a thread, what they are does not."""

from collections.abc import Callable
from typing import Generic, TypeVar

from engine.errors import ModelError
from engine.training import Trainer
from engine.witness import Seam, Witness

T = TypeVar("T")


class WitnessedTrainer(Generic[T]):
    """Another trainer, and when it handed something over."""

    def __init__(self, trainer: Trainer[T], witness: Witness) -> None:
        self._trainer, self._witness = trainer, witness

    def start(self, job: Callable[[], T]) -> None:
        """Begin a job."""
        self._trainer.start(job)

    @property
    def is_busy(self) -> bool:
        """Whether a job was started and its result not yet collected."""
        return self._trainer.is_busy

    def collect(self) -> T | ModelError | None:
        """Return a finished job's result or failure once, without waiting."""
        return self._witness.heard(Seam.TRAINED, self._trainer.collect)
