"""Training settings, and the threads that run training jobs.

The article trains on the first hundred frames: 15 s at its 6.7 frames/s, but one breath at 30 frames/s. Here a set is
complete when it has enough frames, enough time *and* enough complete cycles. If the cycles are not reached within the
longest time, a model is still fitted; it stores its number of cycles.
"""

import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from engine.core.bounds import check_numbers
from engine.core.errors import InvalidValueError, ModelError, TrainingFailedError
from engine.core.native_process import give_freed_memory_back
from engine.core.sentences import say

SHORTEST_INTERVAL_S = 10.0
TRAINING_BOUNDS: Mapping[str, tuple[float, float]] = {
    "min_frames": (20, 1000),
    "min_cycles": (0, 50),
    "min_seconds": (0.0, 300.0),
    "max_seconds": (0.5, 600.0),
    "max_frames": (40, 2000),
    "components": (1, 10),
    "refit_until_s": (0.0, 600.0),
    "retrain_interval_s": (0.0, 14_400.0),
    "min_amplitude_mm": (0.2, 10.0),
    "max_shift_mm": (0.5, 50.0),
    "max_tilt_deg": (0.2, 20.0),
    "max_outlier_share": (0.0, 0.5),
    "max_carry_mm": (0.1, 5.0),
}
"""Lowest and highest value of each setting."""
T = TypeVar("T")


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSettings:
    """Completeness and refusal of a training set, and the number of components.

    Attributes
    ----------
    min_frames, min_cycles, min_seconds
        Least content of a complete set.
    max_seconds
        Longest time of a set; then a model is fitted with fewer cycles.
    max_frames
        Largest number of frames kept; a longer set is thinned evenly.
    components
        Largest number of principal components; those that noise explains are left out.
    refit_until_s
        A model learned in the session is refitted each time the stretch without movement is twice as long as the one
        it was learned from, until the stretch is this long [s]; 0 for never.
    retrain_interval_s
        Time from one model to the next training; 0 for never.
    min_amplitude_mm
        Least breathing excursion: a smaller one is a dummy, a plate or a breath hold.
    max_shift_mm, max_tilt_deg
        Largest movement of the patient between the first and the last third of a set, without the breath.
    max_outlier_share
        Largest share of frames with a cough or an occlusion; they are left out of the fit.
    max_carry_mm
        Largest correction when the reference is transferred to a new model; a larger one indicates a movement.
    """

    min_frames: int = 100
    min_cycles: int = 3
    min_seconds: float = 10.0
    max_seconds: float = 40.0
    max_frames: int = 450
    components: int = 6
    refit_until_s: float = 80.0
    retrain_interval_s: float = 0.0
    min_amplitude_mm: float = 0.6
    max_shift_mm: float = 3.0
    max_tilt_deg: float = 2.0
    max_outlier_share: float = 0.2
    max_carry_mm: float = 1.0

    def __post_init__(self) -> None:
        """Check every number against `TRAINING_BOUNDS`, and their combinations; raise InvalidValueError."""
        check_numbers(self, TRAINING_BOUNDS)
        if 0.0 < self.retrain_interval_s < SHORTEST_INTERVAL_S:
            bound = f"0, or at least {SHORTEST_INTERVAL_S:g}"
            raise InvalidValueError("retrain_interval_s", self.retrain_interval_s, bound)
        if self.max_seconds < self.min_seconds:
            raise InvalidValueError("max_seconds", self.max_seconds, f"at least min_seconds ({self.min_seconds:g})")
        if self.max_frames < 2 * self.min_frames:  # thinning halves the set
            bound = f"at least twice min_frames ({2 * self.min_frames})"
            raise InvalidValueError("max_frames", self.max_frames, bound)


class Trainer(Protocol[T]):
    """Runs one job at a time and returns its result once."""

    def start(self, job: Callable[[], T]) -> None:
        """Start a job; the caller must not start a second one before `collect` has returned the first one's result."""

    @property
    def is_busy(self) -> bool:
        """Whether a job was started and its result not yet collected."""

    def collect(self) -> T | ModelError | None:
        """Return a finished job's result or failure once, without waiting."""


class InlineTrainer(Generic[T]):
    """Runs a job at once, in the caller's thread: for replays, which must not depend on timing."""

    def __init__(self) -> None:
        self._finished: T | ModelError | None = None

    def start(self, job: Callable[[], T]) -> None:
        """Run it now."""
        self._finished = outcome_of(job)

    @property
    def is_busy(self) -> bool:
        """Whether a result waits."""
        return self._finished is not None

    def collect(self) -> T | ModelError | None:
        """Return the result once."""
        finished, self._finished = self._finished, None
        return finished


class OneJobAtATime(Generic[T]):
    """A trainer that works while the engine measures; the engine's thread starts a job and collects its result."""

    def __init__(self) -> None:
        self._finished: queue.SimpleQueue[T | ModelError] = queue.SimpleQueue()
        self._is_busy = False

    def start(self, job: Callable[[], T]) -> None:
        """Start a job; raise ModelError if one is running."""
        if self._is_busy:
            msg = say("a model is being fitted already")
            raise ModelError(msg)
        self._is_busy = True
        self._hand_over(job)

    def _hand_over(self, job: Callable[[], T]) -> None:
        """Have the job worked on, without waiting; its result is put into ``_finished``."""
        raise NotImplementedError

    @property
    def is_busy(self) -> bool:
        """Whether a job is running or its result was not yet collected."""
        return self._is_busy

    def collect(self) -> T | ModelError | None:
        """Return a finished job's result once, without waiting."""
        try:
            finished = self._finished.get_nowait()
        except queue.Empty:
            return None
        self._is_busy = False
        return finished


class BackgroundTrainer(OneJobAtATime[T]):
    """Runs each job in a new thread."""

    def _hand_over(self, job: Callable[[], T]) -> None:
        threading.Thread(target=self._work, args=([job],), name="tidegate-trainer", daemon=True).start()

    def _work(self, jobs: list[Callable[[], T]]) -> None:
        self._finished.put(outcome_of(jobs.pop()))  # popped, so that its frames are released before the next line
        give_freed_memory_back()


def outcome_of(job: Callable[[], T]) -> T | ModelError:
    """Run a job, and return its result or why there is none."""
    try:
        return job()
    except ModelError as error:
        return error
    except MemoryError:
        return TrainingFailedError("there was not enough memory for the training: the model in use stays as it is")
    except Exception as error:  # noqa: BLE001 - any failure of the fit is a refusal; learning must not hang
        return ModelError(f"the fit failed: {type(error).__name__}: {error}")
