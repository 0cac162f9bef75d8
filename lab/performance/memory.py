"""Memory over a long session: a recording repeated through the engine's loop as fast as possible.

With the training process's own memory: what it shares with this one is counted once.
"""

import queue
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from engine.beam.simulated import SimulatedBeamLine
from engine.calibration.camera_calibration import load_calibration
from engine.control.loop import EngineLoop
from engine.control.outputs import LoopStatus
from engine.core.clock import MonotonicClock
from engine.core.frames import RgbdFrame
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.motion.training_process.process_trainer import ProcessTrainer
from lab.performance.machine import (
    SpeedBenchError,
    heap_in_use_bytes,
    own_bytes_of_children,
    resident_bytes,
    set_memory_aside,
    settle_as_the_service,
)
from lab.performance.session import EndlessSource, Recording

if TYPE_CHECKING:
    from engine.motion.learning.tasks import Outcome

MB = 1e6
SPAN_SHARE = 5.0 / 6.0
"""Length of the spans that are compared, as a share of the warm-up: frames are collected and released within one."""

DRAIN_S = 0.5
TRAINING_S = 30.0


@dataclass(frozen=True, slots=True, kw_only=True)
class MemorySizes:
    """Length of the session, end of its warm-up, and interval of retraining [s of the session]."""

    session_s: float
    warm_s: float
    retrain_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryUse:
    """Resident memory of the process that ran a session [MB].

    Attributes
    ----------
    start_mb, end_mb
        Least in the span at the end of the warm-up, and of the session: what remains once a training has ended.
    peak_start_mb, peak_end_mb
        Maximum during the warm-up, and after it.
    used_start_mb, used_end_mb
        Minimum of the allocated heap over the same spans: a leak shows here, memory that the C library keeps does not.
    models
        Number of models learned.
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
        """Growth of resident memory from warm-up to end [MB]."""
        return self.end_mb - self.start_mb


class _SampledSource(EndlessSource):
    """An `EndlessSource` that calls back once per second of the session."""

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
    """Run a session and sample its memory; run it in a process of its own."""
    trainer: ProcessTrainer[Outcome] = ProcessTrainer()
    settle_as_the_service(switch_interval_s)
    resident: list[float] = []
    used: list[float] = []

    def sample() -> None:
        trainer.wait(TRAINING_S)  # a session in real time has a model half a second later, not many frames later
        resident.append(resident_bytes() + own_bytes_of_children())
        used.append(heap_in_use_bytes())

    frames = round(sizes.session_s * recording.fps)
    clock = MonotonicClock()
    training = replace(recording.training, retrain_interval_s=sizes.retrain_s)
    pipeline = Pipeline(load_calibration(recording.calibration), PipelineSettings(training=training), clock, trainer)
    loop = EngineLoop(
        source=_SampledSource(recording, most_frames=frames, on_second=sample),
        measurer=pipeline,
        learner=pipeline.learner,
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
        trainer.close()
    if loop.status.run_state is not LoopStatus.ENDED:
        raise SpeedBenchError(f"the session of the memory benchmark failed: {loop.status.error}")
    return memory_use(resident, used, sizes, frames=frames, models=pipeline.learner.status.model_generation)


def memory_use(resident: list[float], used: list[float], sizes: MemorySizes, *, frames: int, models: int) -> MemoryUse:
    """Compute the figures from resident and allocated memory at each second of the session [bytes]."""
    mb, used_mb = np.array(resident) / MB, np.array(used) / MB
    warm, whole = max(1, round(sizes.warm_s)), len(mb)
    if whole <= warm:
        raise SpeedBenchError(f"a session of {whole} s is shorter than its warm-up of {warm} s")
    span = max(1, round(SPAN_SHARE * warm))
    return MemoryUse(
        session_s=sizes.session_s,
        warm_s=sizes.warm_s,
        frames=frames,
        models=models,
        start_mb=float(mb[warm - span : warm].min()),
        end_mb=float(mb[-span:].min()),
        peak_start_mb=float(mb[:warm].max()),
        peak_end_mb=float(mb[warm:].max()),
        used_start_mb=float(used_mb[warm - span : warm].min()),
        used_end_mb=float(used_mb[-span:].min()),
    )


def _drain(loop: EngineLoop) -> None:
    """Empty the loop's output queues, as recorder and audit do, until it ends."""
    while not loop.status.is_over:
        try:
            loop.samples.get(timeout=DRAIN_S)
        except queue.Empty:
            continue
        for other in (loop.transitions, loop.notices):
            while not other.empty():
                other.get_nowait()
