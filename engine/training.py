"""When a training set is complete and what refuses it, and the threads that fit models.

The article takes the first hundred frames: 15 s at its 6.7 frames a second, one breath at 30. Here a set is complete
when it holds enough frames, enough time *and* enough complete cycles; a patient whose breathing never gives the cycles
gets a model in the end, which says how many it has seen.
"""

import queue
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from engine.errors import InvalidValueError, ModelError
from engine.memory import give_freed_memory_back


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSettings:
    """When a training set is complete, how many components are kept, and what is refused.

    Attributes
    ----------
    min_frames, min_cycles, min_seconds
        What a complete set holds.
    max_seconds
        When waiting for more cycles is no use.
    max_frames
        Most frames kept; a longer set is thinned evenly.
    components
        Principal components to keep.
    retrain_interval_s
        Time from one model to the next training, while the present one measures on; 0 is never.
    min_amplitude_mm
        Least breathing excursion that teaches anything: less is a doll, a plate, or a hold.
    max_shift_mm, max_tilt_deg
        Furthest the patient may move between the first and the last third of a set, breath left out.
    max_outlier_share
        Largest share of frames that may show a cough or a hand; they are left out of the model.
    max_carry_mm
        Largest correction of the zero that a new model may need: more means that something has moved.
    """

    min_frames: int = 100
    min_cycles: int = 3
    min_seconds: float = 10.0
    max_seconds: float = 40.0
    max_frames: int = 450
    components: int = 3
    retrain_interval_s: float = 0.0
    min_amplitude_mm: float = 0.6
    max_shift_mm: float = 3.0
    max_tilt_deg: float = 2.0
    max_outlier_share: float = 0.2
    max_carry_mm: float = 1.0

    def __post_init__(self) -> None:
        """Refuse every number out of its bound, and settings that cannot be met."""
        for name, (low, high) in TRAINING_BOUNDS.items():
            check_bound(name, getattr(self, name), low, high)
        if 0.0 < self.retrain_interval_s < SHORTEST_INTERVAL_S:
            bound = f"0, or at least {SHORTEST_INTERVAL_S:g}"
            raise InvalidValueError("retrain_interval_s", self.retrain_interval_s, bound)
        if self.max_seconds < self.min_seconds:
            raise InvalidValueError("max_seconds", self.max_seconds, f"at least min_seconds ({self.min_seconds:g})")
        if self.max_frames < 2 * self.min_frames:  # thinning halves the set
            bound = f"at least twice min_frames ({2 * self.min_frames})"
            raise InvalidValueError("max_frames", self.max_frames, bound)


SHORTEST_INTERVAL_S = 10.0
TRAINING_BOUNDS: Mapping[str, tuple[float, float]] = {
    "min_frames": (20, 1000),
    "min_cycles": (0, 50),
    "min_seconds": (0.0, 300.0),
    "max_seconds": (0.5, 600.0),
    "max_frames": (40, 2000),
    "components": (1, 10),
    "retrain_interval_s": (0.0, 14_400.0),
    "min_amplitude_mm": (0.2, 10.0),
    "max_shift_mm": (0.5, 50.0),
    "max_tilt_deg": (0.2, 20.0),
    "max_outlier_share": (0.0, 0.5),
    "max_carry_mm": (0.1, 5.0),
}
"""Lowest and highest value of each setting; a site can only choose within."""


def check_bound(field: str, value: object, low: float, high: float) -> None:
    """Refuse a number out of its bound, NaN too, naming field, value and bound."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InvalidValueError(field, value, f"a number from {low:g} to {high:g}")


T = TypeVar("T")
# Giving freed memory back costs the frame beside it some 15 ms: so rarely that hours stay flat, and no oftener.
JOBS_A_TRIM = 10


class Trainer(Protocol[T]):
    """Runs one job at a time, somewhere, and hands its result over once."""

    def start(self, job: Callable[[], T]) -> None:
        """Begin a job; a second one while one runs is a bug of the caller."""

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
        self._finished = _outcome(job)

    @property
    def is_busy(self) -> bool:
        """Whether a result waits."""
        return self._finished is not None

    def collect(self) -> T | ModelError | None:
        """Return the result once."""
        finished, self._finished = self._finished, None
        return finished


class BackgroundTrainer(Generic[T]):
    """Runs jobs in a thread of its own; the engine thread collects between two frames."""

    def __init__(self) -> None:
        self._finished: queue.SimpleQueue[T | ModelError] = queue.SimpleQueue()
        self._is_busy = False
        self._jobs = 0

    def start(self, job: Callable[[], T]) -> None:
        """Begin a job; refuse a second one."""
        if self._is_busy:
            msg = "a model is being fitted already"
            raise ModelError(msg)
        self._is_busy = True
        self._jobs += 1
        arguments = ([job], self._jobs % JOBS_A_TRIM == 0)
        threading.Thread(target=self._work, args=arguments, name="tidegate-trainer", daemon=True).start()

    def _work(self, jobs: list[Callable[[], T]], gives_back: bool) -> None:  # noqa: FBT001 - a thread's argument
        self._finished.put(_outcome(jobs.pop()))  # popped, so that the frames it holds are free by the next line
        if gives_back:
            give_freed_memory_back()

    @property
    def is_busy(self) -> bool:
        """Whether a job runs or its result waits."""
        return self._is_busy

    def collect(self) -> T | ModelError | None:
        """Return a finished job's result once, without waiting."""
        try:
            finished = self._finished.get_nowait()
        except queue.Empty:
            return None
        self._is_busy = False
        return finished


def _outcome(job: Callable[[], T]) -> T | ModelError:
    try:
        return job()
    except ModelError as error:
        return error
    except Exception as error:  # noqa: BLE001 - whatever it was: it teaches nothing, and learning must not hang for it
        return ModelError(f"the fit failed: {type(error).__name__}: {error}")
