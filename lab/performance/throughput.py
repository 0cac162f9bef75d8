"""Throughput of ``tidegate measure`` from disk: the whole command, and its steady rate without start-up.

Times the fit of a model, and the frame path while a model is fitted in the background.
"""

import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

import engine.motion.learning.tasks as tasks_module
from engine.calibration.camera_calibration import load_calibration
from engine.capture.recording_source import OniFileSource
from engine.core.clock import NS_PER_S, MonotonicClock
from engine.core.errors import ModelError
from engine.core.frames import FloatArray, Measurement, MeasurementState
from engine.core.learning_status import LearningEventKind
from engine.motion.learning.tasks import Outcome
from engine.motion.learning.trainer import InlineTrainer, Trainer, TrainingSettings
from engine.motion.settings import PipelineSettings
from engine.motion.training_process.process_trainer import ProcessTrainer
from engine.offline.measure import measure_recording
from lab.performance.machine import (
    SpeedBenchError,
    Timing,
    frames_per_s,
    set_memory_aside,
    settle_as_the_service,
    timing_of,
)
from lab.performance.session import BenchSession, Recording

MAX_FRAMES_PER_FIT = 100
TRAINING_S = 60.0


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


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSizes:
    """Number of training frames of a model, of fits, and of quiet frames before each."""

    frames: int
    fits: int
    quiet_frames: int = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class FitCost:
    """Time to learn a model on a core of its own.

    Attributes
    ----------
    fit_s
        Median time of the fit alone, equations 1 to 5 [s].
    job_s, longest_s
        Median and longest time of the trainer's whole job: checking the frames, the fit, preparing the model and
        transferring the reference [s].
    """

    frames: int
    fits: int
    fit_s: float
    job_s: float
    longest_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FramesWhileFitting:
    """Frame times at the recording's rate while a model was fitted; ``job_s`` is the median time of a fit then [s].

    ``quiet`` is of frames at the same rate before each fit: a processor that waits between frames is slower in each.
    """

    cores: int
    quiet: Timing
    timing: Timing
    fits: int
    job_s: float

    @property
    def p99_ratio(self) -> float:
        """The 99th percentile while a model is fitted over that of quiet frames."""
        return self.timing.p99_us / self.quiet.p99_us


class TimedTrainer:
    """A `Trainer` that records when jobs of another one are started, and when their results are collected."""

    def __init__(self, trainer: Trainer[Outcome]) -> None:
        self._trainer = trainer
        self.began_ns: list[int] = []
        self.ended_ns: list[int] = []

    def start(self, job: Callable[[], Outcome]) -> None:
        """Start a job on the wrapped trainer."""
        self.began_ns.append(time.perf_counter_ns())
        self._trainer.start(job)

    @property
    def is_busy(self) -> bool:
        """Whether a started job's result was not yet collected."""
        return self._trainer.is_busy

    def collect(self) -> Outcome | ModelError | None:
        """Return a finished job's result or failure once, without waiting."""
        outcome = self._trainer.collect()
        if outcome is not None:
            self.ended_ns.append(time.perf_counter_ns())
        return outcome

    @property
    def seconds(self) -> list[float]:
        """Duration of each job [s]."""
        return [(end - begin) / NS_PER_S for begin, end in zip(self.began_ns, self.ended_ns, strict=False)]


def learning_from(frames: int, training: TrainingSettings) -> TrainingSettings:
    """Return settings that fit a model to exactly ``frames`` frames, independent of cycles and time, without refits."""
    return replace(training, min_frames=frames, min_cycles=0, min_seconds=0.0, max_frames=2 * frames, refit_until_s=0.0)


def time_fits(recording: Recording, sizes: FitSizes, switch_interval_s: float) -> FitCost:
    """Time fits one after another without other load; run it in a process of its own."""
    settle_as_the_service(switch_interval_s)
    trainer, fits_ns = TimedTrainer(InlineTrainer()), list[int]()
    session = BenchSession(recording, trainer, training=learning_from(sizes.frames, recording.training))
    with _timed_fits(fits_ns):
        session.learn()
        set_memory_aside()
        for _ in range(sizes.fits):
            retraining = _Retraining(session, sizes.frames)
            while not retraining.is_over:
                session.decide(session.read())
    session.close()
    retrainings_s = trainer.seconds[1:]
    return FitCost(
        frames=sizes.frames,
        fits=len(retrainings_s),
        fit_s=float(np.median(fits_ns)) / NS_PER_S,
        job_s=float(np.median(retrainings_s)),
        longest_s=max(retrainings_s),
    )


@contextmanager
def _timed_fits(spent_ns: list[int]) -> Iterator[None]:
    """Add the duration of each fit inside the block [ns]."""
    fit = tasks_module.__dict__["fit"]

    # `Any`: whatever the fit takes.
    def timed(*args: Any, **kwargs: Any) -> Any:  # noqa: ANN401
        started_ns = time.perf_counter_ns()
        try:
            return fit(*args, **kwargs)
        finally:
            spent_ns.append(time.perf_counter_ns() - started_ns)

    with mock.patch.object(tasks_module, "fit", timed):
        yield


def time_frames_while_fitting(
    recording: Recording, sizes: FitSizes, cores: int, switch_interval_s: float
) -> FramesWhileFitting:
    """Time the frame path while a model is fitted; run it in a process of its own, pinned to ``cores`` cores.

    Training frames are collected as fast as they can be decoded. From the start of the fit until the switch to its
    model, frames come at the recording's rate, as from a camera, and each one is timed.
    """
    settle_as_the_service(switch_interval_s)
    background: ProcessTrainer[Outcome] = ProcessTrainer()
    trainer = TimedTrainer(background)
    session = BenchSession(recording, trainer, training=learning_from(sizes.frames, recording.training))
    session.learn(lambda: background.wait(TRAINING_S))  # frames come faster than the training process starts
    set_memory_aside()
    blocks, quiet_blocks = [], []
    for number in range(1, sizes.fits + 1):
        quiet_blocks.append(_paced(session, _Frames(sizes.quiet_frames), recording.fps))
        retraining = _Retraining(session, sizes.frames)
        while len(trainer.began_ns) == number and not trainer.is_busy:
            session.decide(session.read())
            retraining.raise_failure()
        blocks.append(_paced(session, retraining, recording.fps))
    session.close()
    background.close()
    return FramesWhileFitting(
        cores=cores,
        quiet=timing_of([np.concatenate(quiet_blocks)]),
        timing=timing_of([np.concatenate(blocks)]),
        fits=len(blocks),
        job_s=float(np.median(trainer.seconds[1:])),
    )


def _paced(session: BenchSession, period: "_Retraining | _Frames", fps: float) -> FloatArray:
    """Process frames at the recording's rate until a period is over; return their durations [ns]."""
    period_ns, spent_ns = round(NS_PER_S / fps), []
    due_ns = time.perf_counter_ns()
    session.arm()
    while not period.is_over:
        frame = session.read()  # decode before the frame is due, as a player does
        due_ns += period_ns
        time.sleep(max(due_ns - time.perf_counter_ns(), 0) / NS_PER_S)
        started_ns = time.perf_counter_ns()
        session.decide(frame)
        spent_ns.append(time.perf_counter_ns() - started_ns)
    return np.array(spent_ns, dtype=np.float64)


class _Frames:
    """So many frames."""

    def __init__(self, frames: int) -> None:
        self._left = frames

    @property
    def is_over(self) -> bool:
        """Whether there were so many; call it once per frame."""
        self._left -= 1
        return self._left < 0


class _Retraining:
    """A retraining in progress: over after the switch to the new model; a refused model is an error."""

    def __init__(self, session: BenchSession, frames: int) -> None:
        self._pipeline = session.pipeline
        self._pipeline.learner.take_notices()
        self._before = self._pipeline.learner.status.model_generation
        self._left = MAX_FRAMES_PER_FIT * frames
        self._pipeline.learner.retrain()

    @property
    def is_over(self) -> bool:
        """Whether the new model is in use; call it once per frame."""
        self.raise_failure()
        return self._pipeline.learner.status.model_generation != self._before

    def raise_failure(self) -> None:
        """Raise SpeedBenchError if the model was refused or takes too many frames."""
        self._left -= 1
        for notice in self._pipeline.learner.take_notices():
            if notice.kind is LearningEventKind.REFUSED:
                raise SpeedBenchError(f"a model was refused: {notice.detail}")
        if self._left < 0:
            raise SpeedBenchError(f"no new model after {MAX_FRAMES_PER_FIT} times the training frames")
