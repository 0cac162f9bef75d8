"""A trainer whose jobs run in a training process; a thread hands them over and waits."""

import contextlib
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TypeVar, cast

from engine.core.errors import TrainingFailedError
from engine.motion.learning.trainer import OneJobAtATime, outcome_of
from engine.motion.training_process.server import (
    REPORT,
    REQUEST,
    RUNNING,
    Refusal,
    SharedValueError,
    make_file,
    read_value,
    write_value,
)

T = TypeVar("T")

PATIENCE_S = 60.0
"""A job takes half a second; on a busy core, at its low priority, some ten times that."""
START_S = 60.0
"""A job begins within milliseconds once the training process has started, which takes half a second of a core."""
KILLED_S = 5.0
MODULE = "engine.motion.training_process"
CODE = Path(__file__).parents[3]
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1"}
"""So that numpy starts no threads, which would only wait and could not be forked."""
AGAIN = "the model in use stays as it is; train again"
IDLE_S = 60.0
"""Longer than between a first model and its refits."""


# The engine's side of a training process: hands it a job, waits for its report, and reads the answer.
class _SilentError(Exception):
    """The training process did not report in time, or has ended."""


class TrainingProcess:
    """A running training process; used by one thread at a time.

    Attributes
    ----------
    start_s, patience_s
        A process that does not begin a job within the first is killed, and a job that takes longer than the second [s].
    """

    def __init__(self, process: "subprocess.Popen[bytes]", channel: socket.socket) -> None:
        self._process, self._channel = process, channel
        self.start_s, self.patience_s = START_S, PATIENCE_S
        self._number = 0
        self.is_alive = True

    @classmethod
    def started(cls) -> "TrainingProcess":
        """Start one; the kernel ends it with the calling thread. Raise TrainingFailedError where that fails."""
        ours, its = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        try:
            process = subprocess.Popen(  # noqa: S603 - this very program
                [sys.executable, "-P", "-m", MODULE, str(its.fileno()), str(os.getpid())],
                pass_fds=(its.fileno(),),
                stdin=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": str(CODE), **ONE_THREAD},
            )
        except OSError as error:
            ours.close()
            raise TrainingFailedError(f"the training process does not start ({error.strerror}): {AGAIN}") from error
        finally:
            its.close()
        return cls(process, ours)

    def run(self, jobs: list[Callable[[], T]]) -> T:
        """Run the only job of a list, which is emptied once the job is handed over; return its outcome.

        Raises
        ------
        ModelError
            The job refused its frames.
        TrainingFailedError
            The job, or this process, was killed, hung or failed; there is no outcome.
        """
        self._number += 1
        with _memory_file() as request, _memory_file() as answer:
            try:
                write_value(request, jobs)
                self._run(request, answer)
                outcome = read_value(answer)
            except SharedValueError as error:
                raise TrainingFailedError(f"{error}; {AGAIN}") from error
        if isinstance(outcome, Refusal):
            raise outcome.error()
        return cast("T", outcome)

    def _run(self, request: int, answer: int) -> None:
        """Have the job of one file answered in the other; raise TrainingFailedError where it is not."""
        try:
            socket.send_fds(self._channel, [REQUEST.pack(self._number)], [request, answer])
            job, status = self._report(self.start_s)
        except (_SilentError, OSError) as error:
            self.end()
            raise TrainingFailedError(f"the training process has ended or hangs: {AGAIN}") from error
        assert status == RUNNING
        try:
            _, status = self._report(self.patience_s)
        except _SilentError:
            self._kill_job(job)
            raise TrainingFailedError(
                f"the training took longer than {self.patience_s:g} s and was ended: {AGAIN}"
            ) from None
        if status != 0:
            raise TrainingFailedError(f"the training's process {_cause(status)}: {AGAIN}")

    def _kill_job(self, job: int) -> None:
        """Kill a job that hangs, and this process too where it does not report that."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(job, signal.SIGKILL)  # it is reaped after its report only, so its id is its own
        try:
            self._report(KILLED_S)
        except _SilentError:
            self.end()

    def _report(self, seconds: float) -> tuple[int, int]:
        """Return id and status of the present job's process; raise _SilentError without a report in time."""
        self._channel.settimeout(seconds)
        try:
            message = self._channel.recv(REPORT.size)
        except OSError as error:
            raise _SilentError from error
        if not message:
            raise _SilentError
        number, job, status = REPORT.unpack(message)
        assert number == self._number, "one job runs at a time, and the process ends where a report is missing"
        return job, status

    def end(self) -> None:
        """Kill this process, with its job, and reap it."""
        self.is_alive = False
        self.kill()
        self._process.wait()
        self._channel.close()

    def kill(self) -> None:
        """Kill this process, with its job; a thread that waits for the job goes on. `end` is still to be called."""
        self._process.kill()

    @property
    def process_id(self) -> int:
        """The process's id."""
        return self._process.pid


@contextlib.contextmanager
def _memory_file() -> Iterator[int]:
    file = make_file()
    try:
        yield file
    finally:
        os.close(file)


def _cause(status: int) -> str:
    code = os.waitstatus_to_exitcode(status)
    return f"was killed (signal {-code})" if code < 0 else f"failed (status {code})"


class ProcessTrainer(OneJobAtATime[T]):
    """Runs jobs in a training process, which is started with the session, and again for a job that finds none.

    A session trains in its first minutes, and later on request only: a process without a job for a while is ended, so
    that its memory is free.
    """

    def __init__(self, idle_s: float = IDLE_S) -> None:
        super().__init__()
        self._idle_s = idle_s
        self.process: TrainingProcess | None = None
        self._jobs: queue.SimpleQueue[Callable[[], T] | None] = queue.SimpleQueue()
        self._has_ended = threading.Event()
        self._has_ended.set()
        self._thread = threading.Thread(target=self._work, name="tidegate-trainer", daemon=True)
        self._thread.start()

    def _hand_over(self, job: Callable[[], T]) -> None:
        self._has_ended.clear()
        self._jobs.put(job)

    def wait(self, timeout_s: float) -> bool:
        """Wait until no job is running, for at most so long [s]; return whether that is so. The engine never waits."""
        return self._has_ended.wait(timeout_s)

    def close(self) -> None:
        """End the training process with its job; the kernel does that where the engine's process ends."""
        self._jobs.put(None)
        if self.process is not None:
            self.process.kill()
        self._thread.join()
        self._end()

    def _work(self) -> None:
        with contextlib.suppress(TrainingFailedError):  # the first job tries once more, and says why
            self._ready()
        while True:
            try:
                job = self._jobs.get(timeout=None if self.process is None else self._idle_s)
            except queue.Empty:
                self._end()
                continue
            if job is None:
                return
            waiting = [job]
            del job  # so that its frames are released as soon as they are handed over
            self._finished.put(outcome_of(partial(self._run, waiting)))
            self._has_ended.set()

    def _run(self, waiting: list[Callable[[], T]]) -> T:
        return self._ready().run(waiting)

    def _ready(self) -> TrainingProcess:
        if self.process is None or not self.process.is_alive:
            self.process = TrainingProcess.started()
        return self.process

    def _end(self) -> None:
        process, self.process = self.process, None
        if process is not None:
            process.end()
