"""Throughput of ``tidegate measure`` from disk: the whole command, and its steady rate without start-up."""

import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.calibration.camera_calibration import load_calibration
from engine.capture.recording_source import OniFileSource
from engine.core.clock import MonotonicClock
from engine.core.frames import Measurement, MeasurementState
from engine.lab.performance.figures import frames_per_s
from engine.lab.performance.session import Recording
from engine.motion.settings import PipelineSettings
from engine.offline.measure import measure_recording


@dataclass(frozen=True, slots=True, kw_only=True)
class CommandRun:
    """One run of the command: wall clock time, and processor time of all its processes [s]."""

    seconds: float
    processor_s: float


RunCommand = Callable[[list[Path], Path, tuple[int, ...], int], CommandRun]
"""Runs the command: (recordings, output folder, cores, jobs at a time); the command line supplies it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Throughput:
    """Throughput of one configuration.

    Attributes
    ----------
    name
        The configuration, for the table.
    frames
        Frames of all recordings.
    run
        The run with the median wall clock time.
    steady_per_s
        Rate from the first measured frame to the last [1/s]; None if it was not measured.
    """

    name: str
    frames: int
    run: CommandRun
    steady_per_s: float | None

    @property
    def whole_per_s(self) -> float:
        """Frames per second, start-up, learning and writing included [1/s]."""
        return self.frames / self.run.seconds

    @property
    def per_processor_s(self) -> float:
        """Frames per second of processor time, independent of other load on the machine [1/s]."""
        return self.frames / self.run.processor_s


def measure_by_command(
    recordings: list[Path], cores: tuple[int, ...], jobs: int, *, runs: int, work: Path, run_command: RunCommand
) -> CommandRun:
    """Run the command ``runs`` times and return the run with the median time."""
    done = []
    for _ in range(runs):
        out = Path(tempfile.mkdtemp(prefix="measured-", dir=work))
        try:
            done.append(run_command(recordings, out, cores, jobs))
        finally:
            shutil.rmtree(out, ignore_errors=True)
    return sorted(done, key=lambda run: run.seconds)[len(done) // 2]


def steady_rate(recording: Recording, work: Path) -> float:
    """Measure a recording from disk; return the rate of frames after the first model [1/s]."""
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
            is_single_pass=True,
        )
    finally:
        shutil.rmtree(out, ignore_errors=True)
    return frames_per_s(np.array(stamps_ns, dtype=np.float64))
