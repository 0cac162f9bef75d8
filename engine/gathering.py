"""Frames on their way to a model: gathered by time and cycles, thinned evenly (see :mod:`engine.training`).

Owned by the engine thread, and quick: what judges and fits the frames runs in the trainer's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from engine.frames import BoolArray, FloatArray, RoiDepth, TrainingProgress, frozen
from engine.stages.breathing import count_cycles, excursion_mm
from engine.stages.roi import at_nodes
from engine.training import TrainingSettings

SURROGATE_STEP_PX = 10
JUDGE_EVERY_FRAMES = 10
MAX_GAP_S = 3.0
"""After a longer gap a set begins anew: the patient was lost, and may lie otherwise."""

MIN_SEEN_SHARE = 0.5

Vertices = Callable[[FloatArray, FloatArray], FloatArray]
"""From the nodes' depth pixels (nodes, 2) and depth [mm] (nodes,) to points of the depth camera's frame (nodes, 3)."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GatheredFrame:
    """A frame's region, when it was taken, and where its nodes lie in the depth picture, shape (nodes, 2)."""

    roi: RoiDepth
    timestamp_us: int
    nodes_px: FloatArray

    def surface(self, vertices: Vertices) -> FloatArray:
        """Return the points seen at the nodes [mm], shape (nodes, 3); NaN in holes."""
        valid = at_nodes(self.roi.valid, self.roi.stride_px) > 0.0
        depth_mm = np.where(valid, at_nodes(self.roi.depth_mm, self.roi.stride_px), np.nan)
        return vertices(self.nodes_px, depth_mm)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signals:
    """Coarse motion of every frame that was offered, kept or not.

    Attributes
    ----------
    seconds
        Device time [s], shape (n,).
    motion_mm
        Whole, upper half and lower half against the first frame [mm], shape (n, 3).
    kept
        Which of them belong to the set's frames, in order, shape (frames,).
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
        """The one of the three that breathes most, shape (n,)."""
        depths = [excursion_mm(signal, self.seconds) for signal in self.motion_mm.T]
        return np.asarray(self.motion_mm[:, int(np.argmax(depths))])


class TrainingSet:
    """Gathers frames until there are enough of them."""

    def __init__(self, settings: TrainingSettings, vertices: Vertices) -> None:
        self._settings = settings
        self._vertices = vertices
        self._begin()

    def _begin(self) -> None:
        self._frames: list[GatheredFrame] = []
        self._kept: list[int] = []
        self._stride = 1
        self._seconds: list[float] = []
        self._motion_mm: list[tuple[float, float, float]] = []
        self._centers_mm: list[FloatArray] = []
        self._first: RoiDepth | None = None
        self._cycles = 0
        self._amplitude_mm: float | None = None

    def add(self, frame: GatheredFrame) -> None:
        """Take a frame; when the set is full every second one is dropped, so it stays evenly thinned."""
        seconds = frame.timestamp_us / 1e6
        if self._seconds and not 0.0 < seconds - self._seconds[-1] <= MAX_GAP_S:
            self._begin()
        if self._first is None:
            self._first = frame.roi
        offered = len(self._seconds)
        self._seconds.append(seconds)
        self._motion_mm.append(_coarse_motion_mm(frame.roi, self._first))
        if offered % self._stride == 0:
            self._frames.append(frame)
            self._kept.append(offered)
        if len(self._frames) > self._settings.max_frames:
            self._frames, self._kept = self._frames[::2], self._kept[::2]
            self._stride *= 2
        if offered % JUDGE_EVERY_FRAMES == JUDGE_EVERY_FRAMES - 1:
            self._judge(frame)

    def _judge(self, frame: GatheredFrame) -> None:
        signals, seconds = np.array(self._motion_mm).T, np.array(self._seconds)
        self._cycles = max(count_cycles(signal, seconds) for signal in signals)
        self._amplitude_mm = max(excursion_mm(signal, seconds) for signal in signals)
        surface = frame.surface(self._vertices)
        seen: BoolArray = np.isfinite(surface[:, 2])
        if seen.mean() >= MIN_SEEN_SHARE:
            self._centers_mm.append(surface[seen].mean(axis=0))

    @property
    def frames(self) -> Sequence[GatheredFrame]:
        """The frames of the set, in their order."""
        return tuple(self._frames)

    @property
    def signals(self) -> Signals:
        """What moved, of every frame so far."""
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
        return self._cycles

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
            frames=len(self._frames),
            cycles=self._cycles,
            seconds=self.seconds,
            share=share,
            note=note,
            amplitude_mm=self._amplitude_mm,
            shift_mm=self._shift_mm(),
        )

    def _shift_mm(self) -> float | None:
        """How far the region's centre has moved from the first third to the last [mm]."""
        third = len(self._centers_mm) // 3
        if third == 0:
            return None
        first, last = np.mean(self._centers_mm[:third], axis=0), np.mean(self._centers_mm[-third:], axis=0)
        return float(np.linalg.norm(last - first))


def mean_surface(frames: Sequence[GatheredFrame], vertices: Vertices) -> FloatArray:
    """Average the points seen at the nodes [mm], shape (nodes, 3); NaN where fewer than half of the frames saw one."""
    surfaces = np.stack([frame.surface(vertices) for frame in frames])
    seen = np.asarray(np.isfinite(surfaces).all(axis=2), dtype=np.bool_)
    counts = seen.sum(axis=0)
    sums = np.where(seen[:, :, None], surfaces, 0.0).sum(axis=0)
    enough = counts >= max(1.0, 0.5 * len(frames))
    return np.where(enough[:, None], sums / np.maximum(counts, 1)[:, None], np.nan)


def evenly(frames: Sequence[GatheredFrame], most: int) -> list[GatheredFrame]:
    """Choose at most so many frames, evenly."""
    if len(frames) <= most:
        return list(frames)
    return [frames[i] for i in np.linspace(0, len(frames) - 1, most).round().astype(int)]


def _coarse_motion_mm(roi: RoiDepth, first: RoiDepth) -> tuple[float, float, float]:
    """Mean motion of the whole and of both halves against the first frame [mm], on a coarse grid."""
    step = slice(None, None, SURROGATE_STEP_PX // roi.stride_px)
    both = roi.valid[step, step] & first.valid[step, step]
    motion = np.where(both, first.depth_mm[step, step] - roi.depth_mm[step, step], 0.0)
    half = len(motion) // 2

    def mean(rows: slice) -> float:
        return float(motion[rows].sum() / max(int(both[rows].sum()), 1))

    return mean(slice(None)), mean(slice(half)), mean(slice(half, None))
