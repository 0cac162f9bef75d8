"""Threads that never end, for all calls of the OpenNI2 runtime.

The runtime keeps a record of each thread that ever called it (for its errors, and an event for those that waited), and
checks those threads with ``pthread_kill(thread, 0)`` whenever a new one calls. For a thread that has ended, this reads
memory that is in use elsewhere: the process crashes or hangs, both were observed. So no thread that calls the runtime
may end. A thread that hangs in a driver is not reused.
"""

import logging
import queue
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

_log = logging.getLogger(__name__)
_lock = threading.Lock()
_idle: list["_LastingThread"] = []
_here = threading.local()
T = TypeVar("T")


def run_on_lasting_thread(work: Callable[[], None]) -> threading.Event:
    """Run ``work`` on an idle thread, or a new one; the event is set when it has returned."""
    done = threading.Event()
    with _lock:
        thread = _idle.pop() if _idle else _LastingThread()
    thread.jobs.put((work, done))
    return done


def call_on_lasting_thread(function: Callable[..., T], *arguments: object) -> T:
    """Call ``function`` and wait for it: directly on a lasting thread, else on an idle one."""
    if getattr(_here, "lasts", False):
        return function(*arguments)
    answer: Future[T] = Future()

    def work() -> None:
        try:
            answer.set_result(function(*arguments))
        except BaseException as error:  # noqa: BLE001 - raised again in the caller
            answer.set_exception(error)

    run_on_lasting_thread(work)
    return answer.result()


class _LastingThread:
    """One thread and its jobs; it runs until the process ends."""

    def __init__(self) -> None:
        self.jobs: queue.SimpleQueue[tuple[Callable[[], None], threading.Event]] = queue.SimpleQueue()
        threading.Thread(target=self._serve, name="openni-capture", daemon=True).start()

    def _serve(self) -> None:
        _here.lasts = True
        while True:
            work, done = self.jobs.get()
            try:
                work()
            except BaseException:  # noqa: BLE001
                # A bug, which is logged; ending this thread would let the next one crash the process.
                _log.exception("capture has failed")
            done.set()
            with _lock:
                _idle.append(self)
