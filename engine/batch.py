"""Many recordings, several at a time: each in a process of its own, so that one that breaks takes no other along.

A process tells its parent how far it is, and in the end what came of it. It is a fresh one (spawn): a fork would copy
the locks of whoever calls.
"""

import multiprocessing
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from engine.calibration import load_calibration
from engine.capture.oni_file import OniFileSource
from engine.clock import NS_PER_S, MonotonicClock
from engine.errors import TidegateError
from engine.frames import Measurement
from engine.motion_files import OfflineSummary
from engine.offline import FileTask, measure_recording
from engine.oni.reader import describe

TELL_EVERY_FRAMES = 10
TERMINATED = 128 + signal.SIGTERM


@dataclass(frozen=True, slots=True, kw_only=True)
class FileOutcome:
    """What came of one recording.

    Attributes
    ----------
    summary
        None when it could not be measured.
    frames
        How many were looked at, also when it failed.
    seconds
        Time it took [s]; 0 when its process ended early.
    error
        Why it failed, or what of it could not be read; None when all went well.
    """

    summary: OfflineSummary | None
    frames: int
    seconds: float
    error: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """How far a recording is: frames looked at, of how many."""

    frames: int
    total: int


def measure_file(task: FileTask, tell: Callable[[Progress], None]) -> FileOutcome:
    """Measure one recording; what is wrong with it is part of the outcome."""
    clock = MonotonicClock()
    started_ns = clock.now_ns()
    frames = 0
    summary, error = None, None

    def count(measurement: Measurement) -> None:
        nonlocal frames
        frames = measurement.frame_index + 1
        if frames % TELL_EVERY_FRAMES == 0:
            tell(Progress(frames=frames, total=total))

    try:
        total = describe(task.recording).depth_frames
        tell(Progress(frames=0, total=total))
        summary = measure_recording(
            OniFileSource(task.recording, clock=clock, is_helped=False),  # the other cores measure other files
            load_calibration(task.calibration),
            task.out,
            settings=task.settings,
            limits=task.limits,
            meshes=task.meshes,
            model=task.model,
            origin=task.origin,
            on_frame=count,
        )
        error = summary.damage
    except TidegateError as reason:
        error = str(reason)
    except OSError as reason:
        error = f"{task.out} cannot be written ({reason.strerror or reason})"
    seconds = (clock.now_ns() - started_ns) / NS_PER_S
    return FileOutcome(summary=summary, frames=frames, seconds=seconds, error=error)


def measure_files(
    tasks: Sequence[FileTask],
    jobs: int,
    on_progress: Callable[[int, Progress], None],
    on_outcome: Callable[[int, FileOutcome], None],
) -> list[FileOutcome]:
    """Measure recordings, ``jobs`` at a time; outcomes in the order of the tasks.

    Parameters
    ----------
    on_progress, on_outcome
        Called with a task's position, here in the caller's thread.
    """
    outcomes: dict[int, FileOutcome] = {}
    waiting = list(range(len(tasks)))
    running: dict[Connection, _Run] = {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                position = waiting.pop(0)
                run = _start(position, tasks[position])
                running[run.answers] = run
            for answers in wait(list(running)):
                assert isinstance(answers, Connection), "only connections are waited for"
                run = running[answers]
                news = run.take()
                if isinstance(news, Progress):
                    on_progress(run.position, news)
                    continue
                outcomes[run.position] = news
                del running[answers]
                on_outcome(run.position, news)
    finally:
        for run in running.values():
            run.end()
    return [outcomes[position] for position in range(len(tasks))]


class _Run:
    """A process at work on one recording."""

    def __init__(self, position: int, process: BaseProcess, answers: Connection) -> None:
        self.position = position
        self.answers = answers
        self._process = process
        self._frames = 0

    def take(self) -> Progress | FileOutcome:
        """Take what it tells; a process that ended without a word failed."""
        try:
            news: Progress | FileOutcome = self.answers.recv()
        except EOFError:
            self._process.join()
            code = self._process.exitcode or 0
            reason = f"signal {-code}" if code < 0 else f"exit code {code}"
            return FileOutcome(
                summary=None, frames=self._frames, seconds=0.0, error=f"its process ended early ({reason})"
            )
        if isinstance(news, FileOutcome):
            self._process.join()
        else:
            self._frames = news.frames
        return news

    def end(self) -> None:
        """End it before it is done; it takes its half-written files with it."""
        self._process.terminate()
        self._process.join()


def _start(position: int, task: FileTask) -> _Run:
    context = multiprocessing.get_context("spawn")
    answers, tell = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(task, tell), name=f"tidegate-measure-{position}", daemon=True)
    process.start()
    tell.close()  # the child's end is the only one left: it ends with the child
    return _Run(position, process, answers)


def _work(task: FileTask, tell: Connection) -> None:
    """Run in the child: an interrupt is the parent's to answer, being ended must still clean up."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    tell.send(measure_file(task, tell.send))
    tell.close()
