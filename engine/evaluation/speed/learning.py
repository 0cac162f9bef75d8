"""How long a model takes to fit, and what frames feel of it while it is fitted in the background."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

import engine.errands as errands_module
from engine.clock import NS_PER_S
from engine.errands import Outcome
from engine.errors import ModelError
from engine.evaluation.speed.figures import Timing, timing_of
from engine.evaluation.speed.machine import SpeedBenchError, set_memory_aside, settle_as_the_service
from engine.evaluation.speed.session import BenchSession, Recording
from engine.evaluation.speed.stages import Stage, replaced
from engine.frames import FloatArray
from engine.notices import NoticeKind
from engine.training import BackgroundTrainer, InlineTrainer, Trainer, TrainingSettings

MOST_FRAMES_A_FIT = 100


@dataclass(frozen=True, slots=True, kw_only=True)
class FitSizes:
    """How many frames a model is learned from, and how many times one is fitted."""

    frames: int
    fits: int


@dataclass(frozen=True, slots=True, kw_only=True)
class FitCost:
    """What learning a model takes on a core of its own, medians.

    Attributes
    ----------
    fit_s
        The fit of equations 1 to 5 alone [s].
    job_s, longest_s
        All that the trainer does: judging the frames, the fit, making the model ready, carrying the zero over [s].
    """

    frames: int
    fits: int
    fit_s: float
    job_s: float
    longest_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class FramesWhileFitting:
    """Frames that came at the recording's rate while a model was fitted, and how long a fit took meanwhile [s]."""

    cores: int
    timing: Timing
    fits: int
    job_s: float


class TimedTrainer:
    """A trainer that notes when its jobs ran, wherever the one within runs them."""

    def __init__(self, within: Trainer[Outcome]) -> None:
        self._within = within
        self.began_ns: list[int] = []
        self.ended_ns: list[int] = []

    def start(self, job: Callable[[], Outcome]) -> None:
        """Begin a job."""

        def timed() -> Outcome:
            self.began_ns.append(time.perf_counter_ns())
            try:
                return job()
            finally:
                self.ended_ns.append(time.perf_counter_ns())

        self._within.start(timed)

    @property
    def is_busy(self) -> bool:
        """Whether a job was started and its result not yet collected."""
        return self._within.is_busy

    def collect(self) -> Outcome | ModelError | None:
        """Return a finished job's result or failure once, without waiting."""
        return self._within.collect()

    @property
    def seconds(self) -> list[float]:
        """How long each job took [s]."""
        return [(end - begin) / NS_PER_S for begin, end in zip(self.began_ns, self.ended_ns, strict=False)]


def learning_from(frames: int, training: TrainingSettings) -> TrainingSettings:
    """Return settings under which a model is fitted to exactly so many frames, however the patient breathes."""
    return replace(training, min_frames=frames, min_cycles=0, min_seconds=0.0, max_frames=2 * frames)


def time_fits(recording: Recording, sizes: FitSizes, switch_interval_s: float) -> FitCost:
    """Fit models one after another, nothing else going on; for a process of its own."""
    settle_as_the_service(switch_interval_s)
    trainer, alone_ns = TimedTrainer(InlineTrainer()), []

    def wrap(_name: str, function: Stage) -> Stage:
        def timed(*args: object, **kwargs: object) -> object:
            started_ns = time.perf_counter_ns()
            result = function(*args, **kwargs)
            alone_ns.append(time.perf_counter_ns() - started_ns)
            return result

        return timed

    session = BenchSession(recording, trainer, training=learning_from(sizes.frames, recording.training))
    with replaced(((errands_module, "fit", "fit"),), wrap):
        session.learn()
        set_memory_aside()
        for _ in range(sizes.fits):
            swaps = _Retraining(session, sizes.frames)
            while not swaps.is_over:
                session.decide(session.read())
    session.close()
    again = trainer.seconds[1:]
    return FitCost(
        frames=sizes.frames,
        fits=len(again),
        fit_s=float(np.median(alone_ns)) / NS_PER_S,
        job_s=float(np.median(again)),
        longest_s=max(again),
    )


def time_frames_while_fitting(
    recording: Recording, sizes: FitSizes, cores: int, switch_interval_s: float
) -> FramesWhileFitting:
    """Time the frames that come while a model is fitted; for a process of its own, on so many cores.

    Frames to learn from are gathered as fast as they can be decoded; from where the fit begins until its model has
    taken over they come at the recording's rate, as from a camera, and each one's way is timed.
    """
    settle_as_the_service(switch_interval_s)
    trainer = TimedTrainer(BackgroundTrainer())
    session = BenchSession(recording, trainer, training=learning_from(sizes.frames, recording.training))
    session.learn()
    set_memory_aside()
    blocks = []
    for number in range(1, sizes.fits + 1):
        swaps = _Retraining(session, sizes.frames)
        while len(trainer.began_ns) == number and not trainer.is_busy:
            session.decide(session.read())
            swaps.refuse_failure()
        blocks.append(_paced(session, swaps, recording.fps))
    session.close()
    return FramesWhileFitting(
        cores=cores,
        timing=timing_of([np.concatenate(blocks)]),
        fits=len(blocks),
        job_s=float(np.median(trainer.seconds[1:])),
    )


def _paced(session: BenchSession, swaps: "_Retraining", fps: float) -> FloatArray:
    """Take frames at their rate until the new model has taken over; how long each took [ns]."""
    period_ns, spent_ns = round(NS_PER_S / fps), []
    due_ns = time.perf_counter_ns()
    session.arm()
    while not swaps.is_over:
        frame = session.read()  # before its time has come, as a player does
        due_ns += period_ns
        time.sleep(max(due_ns - time.perf_counter_ns(), 0) / NS_PER_S)
        started_ns = time.perf_counter_ns()
        session.decide(frame)
        spent_ns.append(time.perf_counter_ns() - started_ns)
    return np.array(spent_ns, dtype=np.float64)


class _Retraining:
    """A model on its way: over when it has taken over, and an error when it was refused."""

    def __init__(self, session: BenchSession, frames: int) -> None:
        self._pipeline = session.pipeline
        self._pipeline.take_notices()
        self._before = self._pipeline.model_generation
        self._left = MOST_FRAMES_A_FIT * frames
        self._pipeline.retrain()

    @property
    def is_over(self) -> bool:
        """Whether the new model has taken over; to be asked once a frame."""
        self.refuse_failure()
        return self._pipeline.model_generation != self._before

    def refuse_failure(self) -> None:
        """Raise what the learning was refused for."""
        self._left -= 1
        for notice in self._pipeline.take_notices():
            if notice.kind is NoticeKind.REFUSED:
                raise SpeedBenchError(f"a model was refused: {notice.detail}")
        if self._left < 0:
            raise SpeedBenchError("a model was not ready after many times the frames it is learned from")
