"""Collects the training frames of a model, by time and breathing cycles, thinned evenly.

Owned by the engine thread, so adding a frame is fast; checks and fit run in the trainer's thread.
"""

import mmap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from engine.core.frames import BoolArray, FloatArray, RoiDepth, TrainingProgress, frozen
from engine.core.sentences import say
from engine.motion.breathing import count_cycles, excursion_mm
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.stages.roi import at_nodes

SURROGATE_STEP_PX = 10
PROGRESS_EVERY_FRAMES = 10
MAX_GAP_S = 3.0
"""A longer gap restarts the set: the patient may have moved while lost."""

MIN_SEEN_SHARE = 0.5
ALIGNMENT = 64
"""Of the arrays of a kept frame, for vector instructions."""

Vertices = Callable[[FloatArray, FloatArray], FloatArray]
"""Maps depth pixels (nodes, 2) and depth [mm] (nodes,) to points in the depth camera's frame [mm], (nodes, 3)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrainingFrame:
    """A frame's region, its device time, and its nodes in the depth picture [px], shape (nodes, 2)."""

    roi: RoiDepth
    timestamp_us: int
    nodes_px: FloatArray

    @classmethod
    def kept(cls, roi: RoiDepth, timestamp_us: int, nodes_px: FloatArray) -> "TrainingFrame":
        """Copy a frame to pages of its own, which the system has back with the frame.

        Hundreds of frames on the heap would leave it as large as it was with them.
        """
        arrays = (roi.depth_mm, nodes_px, roi.valid)
        starts = np.cumsum([0, *(-(-array.nbytes // ALIGNMENT) * ALIGNMENT for array in arrays)]).tolist()
        pages = mmap.mmap(-1, starts[-1], flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
        depth_mm, nodes_px, valid = (
            _copied(array, pages, start) for array, start in zip(arrays, starts[:-1], strict=True)
        )
        copied = RoiDepth(depth_mm=depth_mm, valid=valid, stride_px=roi.stride_px)
        return cls(roi=copied, timestamp_us=timestamp_us, nodes_px=frozen(nodes_px))

    def surface(self, vertices: Vertices) -> FloatArray:
        """Return the measured points at the nodes [mm], shape (nodes, 3); NaN in holes."""
        valid = at_nodes(self.roi.valid, self.roi.stride_px) > 0.0
        depth_mm = np.where(valid, at_nodes(self.roi.depth_mm, self.roi.stride_px), np.nan)
        return vertices(self.nodes_px, depth_mm)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signals:
    """Coarse motion of all frames added, including those that were thinned out.

    Attributes
    ----------
    seconds
        Device time [s], shape (n,).
    motion_mm
        Whole, superior half and inferior half relative to the first frame [mm], shape (n, 3).
    kept
        Indices of the set's frames, ascending, shape (frames,).
    """

    seconds: FloatArray
    motion_mm: FloatArray
    kept: FloatArray

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in (self.seconds, self.motion_mm, self.kept):
            frozen(array)

    @property
    def largest(self) -> FloatArray:
        """The signal with the largest excursion [mm], shape (n,)."""
        depths = [excursion_mm(signal, self.seconds) for signal in self.motion_mm.T]
        return np.asarray(self.motion_mm[:, int(np.argmax(depths))])


class _Judged(NamedTuple):
    """Complete breathing cycles of the first ``frames`` frames, and the breathing's amplitude."""

    frames: int = 0
    cycles: int = 0
    amplitude_mm: float | None = None


class TrainingSet:
    """Collects frames until the set is complete; the shift of one that is not watched is not followed."""

    def __init__(self, settings: TrainingSettings, vertices: Vertices, *, is_watched: bool = True) -> None:
        self._settings = settings
        self._vertices = vertices
        self._is_watched = is_watched
        self._begin()

    def _begin(self) -> None:
        self._frames: list[TrainingFrame] = []
        self._kept: list[int] = []
        self._stride = 1
        self._seconds: list[float] = []
        self._motion_mm: list[tuple[float, float, float]] = []
        self._first: RoiDepth | None = None
        self._centers_mm: list[FloatArray] = []
        self._judged = _Judged()

    def snapshot(self) -> "TrainingSet":
        """Return the set as it is now, for another thread; frames added later are not in it."""
        same = TrainingSet(self._settings, self._vertices)
        for name, value in vars(self).items():
            setattr(same, name, list(value) if isinstance(value, list) else value)
        return same

    def add(self, frame: TrainingFrame) -> None:
        """Add a frame; a full set drops every second frame, so it stays evenly thinned."""
        seconds = frame.timestamp_us / 1e6
        if self._seconds and not 0.0 < seconds - self._seconds[-1] <= MAX_GAP_S:
            self._begin()
        if self._first is None:
            self._first = frame.roi
        number = len(self._seconds)
        self._seconds.append(seconds)
        self._motion_mm.append(_coarse_motion_mm(frame.roi, self._first))
        if number % self._stride == 0:
            self._frames.append(frame)
            self._kept.append(number)
        if len(self._frames) > self._settings.max_frames:
            self._frames, self._kept = self._frames[::2], self._kept[::2]
            self._stride *= 2
        if self._is_watched and number % PROGRESS_EVERY_FRAMES == PROGRESS_EVERY_FRAMES - 1:
            self._add_center(frame)

    def _judge(self) -> "_Judged":
        """Judge the breathing of every tenth frame so far, once; a stretch that is only kept is judged by its fit."""
        count = len(self._seconds) - len(self._seconds) % PROGRESS_EVERY_FRAMES
        if count != self._judged.frames:
            signals, seconds = np.array(self._motion_mm[:count]).T, np.array(self._seconds[:count])
            excursions_mm = [excursion_mm(signal, seconds) for signal in signals]
            cycles = count_cycles(signals[int(np.argmax(excursions_mm))], seconds)
            self._judged = _Judged(count, cycles, max(excursions_mm))
        return self._judged

    def _add_center(self, frame: TrainingFrame) -> None:
        """Add the region's centre [mm], if enough of it is seen."""
        surface = frame.surface(self._vertices)
        seen: BoolArray = np.isfinite(surface[:, 2])
        if seen.mean() >= MIN_SEEN_SHARE:
            self._centers_mm.append(surface[seen].mean(axis=0))

    @property
    def frames(self) -> Sequence[TrainingFrame]:
        """The frames of the set, in order of time."""
        return tuple(self._frames)

    @property
    def signals(self) -> Signals:
        """Coarse motion of all frames so far."""
        return Signals(
            seconds=np.array(self._seconds), motion_mm=np.array(self._motion_mm), kept=np.array(self._kept, dtype=int)
        )

    @property
    def seconds(self) -> float:
        """Time from the first frame to the last [s]."""
        return self._seconds[-1] - self._seconds[0] if self._seconds else 0.0

    @property
    def cycles(self) -> int:
        """Complete breathing cycles so far."""
        return self._judge().cycles

    @property
    def is_complete(self) -> bool:
        """Whether the set has enough frames, cycles and time, or has reached the longest time."""
        settings = self._settings
        if len(self._frames) < settings.min_frames:
            return False
        if self.seconds >= settings.max_seconds:
            return True
        return self.seconds >= settings.min_seconds and self.cycles >= settings.min_cycles

    @property
    def progress(self) -> TrainingProgress:
        """Progress of the collection."""
        settings, judged = self._settings, self._judge()
        share = min(
            len(self._frames) / settings.min_frames,
            self.seconds / settings.min_seconds if settings.min_seconds else 1.0,
            judged.cycles / settings.min_cycles if settings.min_cycles else 1.0,
            1.0,
        )
        note = ""
        if share < 1.0 and self.seconds >= 0.5 * settings.max_seconds:
            note = say(
                "{cycles} complete breathing cycles in {seconds:.0f} s: {min_cycles} are needed",
                cycles=judged.cycles,
                seconds=self.seconds,
                min_cycles=settings.min_cycles,
            )
        return TrainingProgress(
            frames=len(self._frames),
            cycles=judged.cycles,
            seconds=self.seconds,
            share=share,
            note=note,
            amplitude_mm=judged.amplitude_mm,
            shift_mm=self._shift_mm(),
        )

    def _shift_mm(self) -> float | None:
        """Distance of the region's centre between the first and the last third [mm]."""
        third = len(self._centers_mm) // 3
        if third == 0:
            return None
        first, last = np.mean(self._centers_mm[:third], axis=0), np.mean(self._centers_mm[-third:], axis=0)
        return float(np.linalg.norm(last - first))


def _copied(array: npt.NDArray[Any], pages: mmap.mmap, start: int) -> npt.NDArray[Any]:
    copy = np.frombuffer(pages, array.dtype, array.size, start).reshape(array.shape)
    copy[...] = array
    return copy


def mean_surface(frames: Sequence[TrainingFrame], vertices: Vertices) -> FloatArray:
    """Average the measured points at the nodes [mm], shape (nodes, 3); NaN where under half of the frames have one."""
    surfaces = np.stack([frame.surface(vertices) for frame in frames])
    seen = np.asarray(np.isfinite(surfaces).all(axis=2), dtype=np.bool_)
    counts = seen.sum(axis=0)
    sums = np.where(seen[:, :, None], surfaces, 0.0).sum(axis=0)
    enough = counts >= max(1.0, 0.5 * len(frames))
    return np.where(enough[:, None], sums / np.maximum(counts, 1)[:, None], np.nan)


def evenly(frames: Sequence[TrainingFrame], most: int) -> list[TrainingFrame]:
    """Select at most ``most`` frames, evenly spaced."""
    if len(frames) <= most:
        return list(frames)
    return [frames[i] for i in np.linspace(0, len(frames) - 1, most).round().astype(int)]


def _coarse_motion_mm(roi: RoiDepth, first: RoiDepth) -> tuple[float, float, float]:
    """Mean motion of the whole and of both halves relative to the first frame [mm], on a coarse grid."""
    step = slice(None, None, SURROGATE_STEP_PX // roi.stride_px)
    both = roi.valid[step, step] & first.valid[step, step]
    motion = np.where(both, first.depth_mm[step, step] - roi.depth_mm[step, step], 0.0)
    half = len(motion) // 2

    def mean(rows: slice) -> float:
        return float(motion[rows].sum() / max(int(np.count_nonzero(both[rows])), 1))

    return mean(slice(None)), mean(slice(half)), mean(slice(half, None))
