"""Memory over a long session: a recording played over and over through the engine's loop, as fast as it can."""

import queue
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from engine.beam.simulated import SimulatedBeamLine
from engine.calibration import load_calibration
from engine.clock import MonotonicClock
from engine.evaluation.speed.machine import (
    SpeedBenchError,
    heap_in_use_bytes,
    resident_bytes,
    set_memory_aside,
    settle_as_the_service,
)
from engine.evaluation.speed.session import EndlessSource, Recording
from engine.frames import RgbdFrame
from engine.live import LoopStatus
from engine.loop import EngineLoop
from engine.pipeline import Pipeline, PipelineSettings
from engine.training import BackgroundTrainer

MB = 1e6
JUDGED_SHARE = 0.2
"""How much of the time before each of the two moments is looked at."""

DRAIN_S = 0.5


@dataclass(frozen=True, slots=True, kw_only=True)
class MemorySizes:
    """A session's length, where the comparison begins, and how often another model is learned [s of the session]."""

    session_s: float
    warm_s: float
    retrain_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryUse:
    """Resident memory of the process that ran a session [MB].

    Attributes
    ----------
    start_mb, end_mb
        Median over a little while before the warm-up's end, and before the session's.
    peak_start_mb, peak_end_mb
        Largest up to the warm-up's end, and after it.
    used_start_mb, used_end_mb
        Least of the heap in use over the same little whiles: a leak grows here, memory kept for later does not.
    models
        How many were learned on the way.
    """

    session_s: float
    warm_s: float
    frames: int
    models: int
    start_mb: float
    end_mb: float
    peak_start_mb: float
    peak_end_mb: float
    used_start_mb: float
    used_end_mb: float

    @property
    def growth_mb(self) -> float:
        """How much more is resident at the end [MB]."""
        return self.end_mb - self.start_mb


class _WatchedSource(EndlessSource):
    """Looks at the memory once for every second of the session."""

    def __init__(self, recording: Recording, *, most_frames: int, on_second: Callable[[], None]) -> None:
        super().__init__(recording, most_frames=most_frames)
        self._each, self._on_second = max(1, round(recording.fps)), on_second

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame."""
        frame = super().read(timeout_s)
        if frame.index % self._each == self._each - 1:
            self._on_second()
        return frame


def watch_memory(recording: Recording, sizes: MemorySizes, switch_interval_s: float) -> MemoryUse:
    """Run a whole session and watch its memory; for a process of its own."""
    settle_as_the_service(switch_interval_s)
    resident: list[float] = []
    used: list[float] = []

    def look() -> None:
        resident.append(resident_bytes())
        used.append(heap_in_use_bytes())

    frames = round(sizes.session_s * recording.fps)
    clock = MonotonicClock()
    training = replace(recording.training, retrain_interval_s=sizes.retrain_s)
    pipeline = Pipeline(
        load_calibration(recording.calibration), PipelineSettings(training=training), clock, BackgroundTrainer()
    )
    loop = EngineLoop(
        source=_WatchedSource(recording, most_frames=frames, on_second=look),
        pipeline=pipeline,
        beam=SimulatedBeamLine(clock),
        limits=recording.limits,
        clock=clock,
    )
    set_memory_aside()
    loop.start()
    try:
        _drain(loop)
    finally:
        loop.stop(timeout_s=10.0)
    if loop.status is not LoopStatus.ENDED:
        raise SpeedBenchError(f"the session for the memory's sake failed: {loop.error}")
    return memory_use(resident, used, sizes, frames=frames, models=pipeline.model_generation)


def memory_use(resident: list[float], used: list[float], sizes: MemorySizes, *, frames: int, models: int) -> MemoryUse:
    """Sum up what was resident, and what of the heap was in use, at each second of the session [bytes]."""
    mb, used_mb = np.array(resident) / MB, np.array(used) / MB
    warm, whole = max(1, round(sizes.warm_s)), len(mb)
    if whole <= warm:
        raise SpeedBenchError(f"a session of {whole} s is over before the {warm} s that it warms up for")
    judged = max(1, round(JUDGED_SHARE * warm))
    return MemoryUse(
        session_s=sizes.session_s,
        warm_s=sizes.warm_s,
        frames=frames,
        models=models,
        start_mb=float(np.median(mb[warm - judged : warm])),
        end_mb=float(np.median(mb[-judged:])),
        peak_start_mb=float(mb[:warm].max()),
        peak_end_mb=float(mb[warm:].max()),
        used_start_mb=float(used_mb[warm - judged : warm].min()),
        used_end_mb=float(used_mb[-judged:].min()),
    )


def _drain(loop: EngineLoop) -> None:
    """Take what leaves the loop, as the recorder and the audit do, until it is over."""
    while not loop.status.is_over:
        try:
            loop.samples.get(timeout=DRAIN_S)
        except queue.Empty:
            continue
        for other in (loop.transitions, loop.notices):
            while not other.empty():
                other.get_nowait()
