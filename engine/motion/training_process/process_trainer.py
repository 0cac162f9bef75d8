"""A trainer whose jobs run in a training process; a thread hands them over and waits."""

import contextlib
import queue
import threading
from collections.abc import Callable
from functools import partial
from typing import TypeVar

from engine.core.errors import TrainingFailedError
from engine.motion.learning.trainer import OneJobAtATime, outcome_of
from engine.motion.training_process.client import TrainingProcess

T = TypeVar("T")

IDLE_S = 60.0
"""Longer than between a first model and its refits."""


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
