"""Shutdown: the beam is held at the signal, and the process ends within a time limit.

A dedicated thread holds the beam and closes the session at the signal, even if the event loop is busy or requests wait
for worker threads. A second thread ends the process if the orderly shutdown takes too long.
"""

import contextlib
import logging
import os
import sys
import threading
import time
from collections.abc import Callable

from service.core.logging.nonblocking import flush_log

logger = logging.getLogger(__name__)

WITHIN_S = 4.7
"""Longest time from the signal to the end of the process; below the 10 s after which orchestrators kill."""
Leave = Callable[[int], None]


def leave_at_once(code: int = 0) -> None:
    """End the process without the interpreter's own tidying up: all that matters is closed, and memory needs none.

    That tidying up would wait for blocked worker threads, and takes seconds on a busy machine.
    """
    flush_log()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


class Shutdown:
    """Runs once, when the process receives the stop signal.

    Parameters
    ----------
    hold_and_close
        Holds the beam, then closes what goes on; returns within seconds.
    leave
        Ends the process with a code, without any ado (``os._exit``); None where something else is to go on in it.
    """

    def __init__(
        self, hold_and_close: Callable[[], None], *, leave: Leave | None = None, within_s: float = WITHIN_S
    ) -> None:
        self._hold_and_close = hold_and_close
        self._leave = leave
        self._within_s = within_s
        self._told_by, self._tell_by = os.pipe()
        self._asked_at_s: float | None = None
        self._asked = threading.Event()
        self._is_closed = threading.Event()
        self._failed = False
        self._is_watched = False

    @property
    def is_closed(self) -> bool:
        """Whether the beam is held and the session closed, or the attempt has failed."""
        return self._is_closed.is_set()

    def wait(self) -> None:
        """Wait until the beam is held and the session closed."""
        self._is_closed.wait()

    def watch(self) -> None:
        """Start the waiting thread; once."""
        if self._is_watched:
            return
        self._is_watched = True
        threading.Thread(target=self._hold, name="tidegate-stop", daemon=True).start()
        if self._leave is not None:
            threading.Thread(target=self._see_to_the_end, args=(self._leave,), name="tidegate-end", daemon=True).start()

    def ask(self) -> None:
        """Request the shutdown, from any thread or signal handler; takes no lock that a handler may interrupt."""
        if self._asked_at_s is None:
            self._asked_at_s = time.monotonic()
        os.write(self._tell_by, b"!")

    def _hold(self) -> None:
        os.read(self._told_by, 1)
        self._asked.set()
        try:
            self._hold_and_close()
        except Exception:
            self._failed = True
            logger.critical("the session could not be closed; the beam is held", exc_info=True)
        finally:
            self._is_closed.set()

    def _see_to_the_end(self, leave: Leave) -> None:
        self._asked.wait()
        asked_at_s = self._asked_at_s or time.monotonic()
        time.sleep(max(0.0, asked_at_s + self._within_s - time.monotonic()))
        is_done = self.is_closed and not self._failed
        logger.error(
            "not everything had ended %.1f s after the signal; the beam is held, the session is %s",
            self._within_s,
            "closed" if is_done else "NOT closed: the next start does that",
        )
        flush_log()
        leave(0 if is_done else 1)
