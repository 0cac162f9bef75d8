"""Threads that never end, lent to whoever calls the OpenNI2 runtime.

The runtime keeps a record of each thread that ever called it (for its errors, and an event for those that waited), and
asks the system about those threads whenever a new one comes: ``pthread_kill(thread, 0)``. Asking so about a thread that
has ended reads memory that is somebody else's by then: it crashes the process or waits for ever, both were seen. So no
thread that calls the runtime may end. A thread that hangs in a driver is simply never given back.
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
    """Call ``function`` and wait for it: directly on a lasting thread, else on one that is lent for it."""
    if getattr(_here, "lasts", False):
        return function(*arguments)
    answer: Future[T] = Future()

    def work() -> None:
        try:
            answer.set_result(function(*arguments))
        except BaseException as error:  # noqa: BLE001 - whatever it was belongs to the caller
            answer.set_exception(error)

    run_on_lasting_thread(work)
    return answer.result()


class _LastingThread:
    """One thread and its jobs; it lives until the process ends."""

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
                # A bug, and it must be seen; but if it ended this thread, the next one would crash the process.
                _log.exception("capture has failed")
            done.set()
            with _lock:
                _idle.append(self)
