"""Measures several recordings in parallel, each in a process of its own, so that a crash affects only one.

A child process sends its progress and finally its outcome to the parent. Processes are spawned: a fork would copy the
locks of the parent's threads.
"""

import multiprocessing
import signal
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess

from engine.calibration.camera_calibration import load_calibration
from engine.capture.oni.reader import describe
from engine.capture.recording_source import OniFileSource
from engine.core.clock import NS_PER_S, MonotonicClock
from engine.core.errors import TidegateError
from engine.core.frames import Measurement
from engine.offline.measure import FileTask, measure_recording
from engine.offline.result_files import OfflineSummary

PROGRESS_EVERY_FRAMES = 10
TERMINATED = 128 + signal.SIGTERM


@dataclass(frozen=True, slots=True, kw_only=True)
class FileOutcome:
    """Outcome of one recording.

    Attributes
    ----------
    summary
        None if it could not be measured.
    frames
        Number of frames processed in the last pass, also of a failed run.
    seconds
        Wall clock time [s]; 0 if its process ended early.
    error
        Reason of the failure, or the damage in the recording; None without either.
    """

    summary: OfflineSummary | None
    frames: int
    seconds: float
    error: str | None


@dataclass(frozen=True, slots=True, kw_only=True)
class Progress:
    """Progress of a recording: frames processed in all passes, and their total."""

    frames: int
    total: int


def measure_file(task: FileTask, on_progress: Callable[[Progress], None]) -> FileOutcome:
    """Measure one recording; errors of recording, calibration or output folder are part of the outcome."""
    clock = MonotonicClock()
    started_ns = clock.now_ns()
    frames = earlier = 0
    summary, error = None, None

    def begin(_number: int) -> None:
        nonlocal earlier
        earlier = frames

    def count(measurement: Measurement) -> None:
        nonlocal frames
        frames = measurement.frame_index + 1
        if frames % PROGRESS_EVERY_FRAMES == 0:
            on_progress(Progress(frames=earlier + frames, total=total))

    try:
        total = describe(task.recording).depth_frames * passes_of(task)
        on_progress(Progress(frames=0, total=total))
        summary = measure_recording(
            OniFileSource(task.recording, clock=clock, is_helped=False),  # the other cores measure other recordings
            load_calibration(task.calibration),
            task.out,
            settings=task.settings,
            limits=task.limits,
            meshes=task.meshes,
            model=task.model,
            origin=task.origin,
            on_frame=count,
            is_single_pass=task.is_single_pass,
            on_pass=begin,
        )
        error = summary.damage
    except TidegateError as reason:
        error = str(reason)
    except OSError as reason:
        error = f"{task.out} cannot be written ({reason.strerror or reason})"
    seconds = (clock.now_ns() - started_ns) / NS_PER_S
    return FileOutcome(summary=summary, frames=frames, seconds=seconds, error=error)


def passes_of(task: FileTask) -> int:
    """Return how often the frames of a recording are read."""
    return 1 if task.is_single_pass else 2


def measure_files(
    jobs: int,
    tasks: Sequence[FileTask],
    on_progress: Callable[[int, Progress], None],
    on_outcome: Callable[[int, FileOutcome], None],
) -> list[FileOutcome]:
    """Measure recordings, ``jobs`` at a time; return the outcomes in the order of the tasks.

    Parameters
    ----------
    on_progress, on_outcome
        Called in the caller's thread with a task's position and its progress or outcome.
    """
    outcomes: dict[int, FileOutcome] = {}
    waiting = list(range(len(tasks)))
    running: dict[Connection, _Run] = {}
    try:
        while waiting or running:
            while waiting and len(running) < jobs:
                position = waiting.pop(0)
                run = _start(position, tasks[position])
                running[run.receiver] = run
            for receiver in wait(list(running)):
                assert isinstance(receiver, Connection), "only connections are waited for"
                run = running[receiver]
                message = run.receive()
                if isinstance(message, Progress):
                    on_progress(run.position, message)
                    continue
                outcomes[run.position] = message
                del running[receiver]
                on_outcome(run.position, message)
    finally:
        for run in running.values():
            run.end()
    return [outcomes[position] for position in range(len(tasks))]


class _Run:
    """The child process of one recording."""

    def __init__(self, position: int, process: BaseProcess, receiver: Connection) -> None:
        self.position = position
        self.receiver = receiver
        self._process = process
        self._frames = 0

    def receive(self) -> Progress | FileOutcome:
        """Receive a message; a process that ended without an outcome has failed."""
        try:
            message: Progress | FileOutcome = self.receiver.recv()
        except EOFError:
            self._process.join()
            code = self._process.exitcode or 0
            reason = f"signal {-code}" if code < 0 else f"exit code {code}"
            return FileOutcome(
                summary=None, frames=self._frames, seconds=0.0, error=f"its process ended early ({reason})"
            )
        if isinstance(message, FileOutcome):
            self._process.join()
        else:
            self._frames = message.frames
        return message

    def end(self) -> None:
        """Terminate the process; it removes its partial files."""
        self._process.terminate()
        self._process.join()


def _start(position: int, task: FileTask) -> _Run:
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(task, sender), name=f"tidegate-measure-{position}", daemon=True)
    process.start()
    sender.close()  # only the child's copy stays open, so the pipe ends with the child
    return _Run(position, process, receiver)


def _work(task: FileTask, sender: Connection) -> None:
    """Measure in the child process: ignore SIGINT, which the parent handles; clean up on SIGTERM."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(TERMINATED))
    sender.send(measure_file(task, sender.send))
    sender.close()
