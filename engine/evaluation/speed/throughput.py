"""How fast recordings are measured from disk in a steady state: reading, decoding, measuring, writing, no start-up."""

import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.calibration import load_calibration
from engine.capture.oni_file import OniFileSource
from engine.clock import MonotonicClock
from engine.evaluation.speed.figures import frames_per_s
from engine.evaluation.speed.session import Recording
from engine.frames import Measurement, MeasurementState
from engine.offline import measure_recording
from engine.pipeline import PipelineSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandRun:
    """One run of the command: how long it took, and the processor time of all its processes [s]."""

    seconds: float
    processor_s: float


RunCommand = Callable[[list[Path], Path, tuple[int, ...], int], CommandRun]
"""Measures recordings into a folder on these cores, so many at a time, as a user would; supplied from above."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Throughput:
    """Measuring from disk on some cores.

    Attributes
    ----------
    name
        What was done.
    frames
        Of all recordings together.
    run
        The run of the median time among all.
    steady_per_s
        From the first measured frame to the last [1/s]; None where it was not asked for.
    """

    name: str
    frames: int
    run: CommandRun
    steady_per_s: float | None

    @property
    def whole_per_s(self) -> float:
        """Start-up, learning and writing included [1/s]."""
        return self.frames / self.run.seconds

    @property
    def per_processor_s(self) -> float:
        """Frames for each second of processor time, whoever else uses the machine [1/s]."""
        return self.frames / self.run.processor_s


def measure_by_command(
    recordings: list[Path], cores: tuple[int, ...], jobs: int, *, runs: int, work: Path, run_command: RunCommand
) -> CommandRun:
    """Run the command several times; the one of the median time."""
    done = []
    for _ in range(runs):
        out = Path(tempfile.mkdtemp(prefix="measured-", dir=work))
        try:
            done.append(run_command(recordings, out, cores, jobs))
        finally:
            shutil.rmtree(out, ignore_errors=True)
    return sorted(done, key=lambda run: run.seconds)[len(done) // 2]


def steady_rate(recording: Recording, work: Path) -> float:
    """Measure a recording from disk, and tell the rate of frames once a model is there [1/s]; in its own process."""
    stamps_ns: list[int] = []

    def stamp(measurement: Measurement) -> None:
        if stamps_ns or measurement.state is MeasurementState.MEASURING:
            stamps_ns.append(time.perf_counter_ns())

    out = Path(tempfile.mkdtemp(prefix="measured-", dir=work))
    try:
        measure_recording(
            OniFileSource(recording.path, clock=MonotonicClock()),
            load_calibration(recording.calibration),
            out,
            settings=PipelineSettings(training=recording.training),
            on_frame=stamp,
        )
    finally:
        shutil.rmtree(out, ignore_errors=True)
    return frames_per_s(np.array(stamps_ns, dtype=np.float64))
