"""Gather training frames by time and cycles, fit in the background, hand a finished model over.

The article takes the first hundred frames: 15 s at its 6.7 frames a second, one breath at 30. Here a set is complete
when it holds enough frames, enough time *and* enough complete cycles; a patient whose breathing never gives the cycles
gets a model in the end, which says how many it has seen.
"""

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np

from engine.errors import InvalidValueError, ModelError
from engine.frames import RoiDepth, TrainingProgress
from engine.model import MotionModel, fit
from engine.stages.breathing import count_cycles
from engine.stages.preprocessing import fill_holes, smooth_bilateral

SURROGATE_STEP = 10
CYCLES_EVERY_FRAMES = 10


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingSettings:
    """When a training set is complete, and how many components are kept."""

    min_frames: int = 100
    min_cycles: int = 3
    min_seconds: float = 10.0
    max_seconds: float = 40.0
    max_frames: int = 450
    components: int = 3

    def __post_init__(self) -> None:
        """Refuse settings that cannot be met."""
        _bounded("min_frames", self.min_frames, 20, 2000)
        _bounded("min_cycles", self.min_cycles, 0, 50)
        _bounded("min_seconds", self.min_seconds, 0.0, 300.0)
        _bounded("max_seconds", self.max_seconds, self.min_seconds, 600.0)
        _bounded("max_frames", self.max_frames, 2 * self.min_frames, 2000)  # thinning halves the set
        _bounded("components", self.components, 1, 10)


def _bounded(field: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise InvalidValueError(field, value, f"from {low:g} to {high:g}")


class TrainingSet:
    """Frames on their way to a model; owned by the engine thread."""

    def __init__(self, settings: TrainingSettings) -> None:
        self._settings = settings
        self._frames: list[RoiDepth] = []
        self._stride = 1
        self._offered = 0
        self._seconds: list[float] = []
        self._surrogates: list[tuple[float, float, float]] = []
        self._first: RoiDepth | None = None
        self._cycles = 0

    def add(self, roi: RoiDepth, timestamp_us: int) -> None:
        """Take a frame; when the set is full every second one is dropped, so it stays evenly thinned."""
        if self._first is None:
            self._first = roi
        self._seconds.append(timestamp_us / 1e6)
        self._surrogates.append(_surrogates(roi, self._first))
        if self._offered % self._stride == 0:
            self._frames.append(roi)
        self._offered += 1
        if len(self._frames) > self._settings.max_frames:
            self._frames = self._frames[::2]
            self._stride *= 2
        if self._offered % CYCLES_EVERY_FRAMES == 0:
            signals = np.array(self._surrogates)
            seconds = np.array(self._seconds)
            self._cycles = max(count_cycles(signal, seconds) for signal in signals.T)

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last [s]."""
        return self._seconds[-1] - self._seconds[0] if self._seconds else 0.0

    @property
    def is_complete(self) -> bool:
        """Whether it is time to fit: everything needed is there, or waiting longer is no use."""
        wanted = self._settings
        if len(self._frames) < wanted.min_frames:
            return False
        if self.seconds >= wanted.max_seconds:
            return True
        return self._cycles >= wanted.min_cycles and self.seconds >= wanted.min_seconds

    @property
    def progress(self) -> TrainingProgress:
        """How far the gathering has come."""
        wanted = self._settings
        share = min(
            len(self._frames) / wanted.min_frames,
            self.seconds / wanted.min_seconds if wanted.min_seconds else 1.0,
            self._cycles / wanted.min_cycles if wanted.min_cycles else 1.0,
            1.0,
        )
        note = ""
        if share < 1.0 and self.seconds >= 0.5 * wanted.max_seconds:
            note = (
                f"{self._cycles} complete breathing cycles seen in {self.seconds:.0f} s: {wanted.min_cycles} are needed"
            )
        return TrainingProgress(
            frames=len(self._frames), cycles=self._cycles, seconds=self.seconds, share=share, note=note
        )

    def job(self, calibration_sha256: str) -> Callable[[], MotionModel]:
        """Return the fit of these frames as a function, to run anywhere."""
        frames, progress, components = self._frames, self.progress, self._settings.components

        def run() -> MotionModel:
            ready = [smooth_bilateral(fill_holes(roi)) for roi in frames]
            return fit(
                np.stack([roi.depth_mm for roi in ready]),
                np.stack([roi.valid for roi in ready]),
                components=components,
                cycles=progress.cycles,
                seconds=progress.seconds,
                calibration_sha256=calibration_sha256,
            )

        return run


def _surrogates(roi: RoiDepth, first: RoiDepth) -> tuple[float, float, float]:
    """Mean motion of the whole and of both halves against the first frame [mm], on a coarse grid."""
    step = slice(None, None, SURROGATE_STEP)
    both = roi.valid[step, step] & first.valid[step, step]
    motion = np.where(both, first.depth_mm[step, step] - roi.depth_mm[step, step], 0.0)
    half = len(motion) // 2

    def mean(rows: slice) -> float:
        return float(motion[rows].sum() / max(int(both[rows].sum()), 1))

    return mean(slice(None)), mean(slice(half)), mean(slice(half, None))


T = TypeVar("T")


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

    def start(self, job: Callable[[], T]) -> None:
        """Begin a job; refuse a second one."""
        if self._is_busy:
            msg = "a model is being fitted already"
            raise ModelError(msg)
        self._is_busy = True
        threading.Thread(target=lambda: self._finished.put(_outcome(job)), name="tidegate-trainer", daemon=True).start()

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
    except (MemoryError, ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
        return ModelError(f"the fit failed: {error}")
