"""A log that nobody waits for: lines are left in a bounded queue, and a thread of its own writes them down.

Standard error may be a pipe whose reader has stopped: a line that waits for it would keep the event loop, and with it
every call to hold a beam, from being answered. What finds no room is counted instead.
"""

import contextlib
import logging
import queue
import sys
import threading
from typing import TextIO

MOST_LINES = 4096
FLUSH_S = 0.3
"""How long the end of the process waits for its last lines."""


class NonblockingHandler(logging.Handler):
    """Formats where something is logged, which knows the request, and writes elsewhere."""

    def __init__(self, stream: TextIO | None = None, *, most_lines: int = MOST_LINES) -> None:
        super().__init__()
        self._stream = stream or sys.stderr
        self._lines: queue.Queue[str | threading.Event] = queue.Queue(most_lines)
        self.dropped = 0
        self._thread = threading.Thread(target=self._write_on, name="tidegate-log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Leave a line; never waits for whoever reads it."""
        try:
            self._lines.put_nowait(self.format(record))
        except queue.Full:
            self.dropped += 1
        except Exception:  # noqa: BLE001 - a line that cannot be written must not break what it is about
            self.dropped += 1

    def flush(self) -> None:
        """Wait for what was left so far, and not for long."""
        if not self._thread.is_alive() or threading.current_thread() is self._thread:
            return
        written = threading.Event()
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(written)
            written.wait(FLUSH_S)

    def _write_on(self) -> None:
        while True:
            self._do(self._lines.get())

    def _do(self, line: str | threading.Event) -> None:
        if isinstance(line, threading.Event):
            line.set()
            return
        with contextlib.suppress(OSError, ValueError):  # the reader has gone, or the stream is closed
            self._stream.write(f"{line}\n")
            self._stream.flush()


def dropped_lines() -> int:
    """Return how many lines found no room since the start."""
    return sum(one.dropped for one in logging.getLogger().handlers if isinstance(one, NonblockingHandler))


def flush_log() -> None:
    """Write down what waits, before the process leaves without its usual way out."""
    for one in logging.getLogger().handlers:
        one.flush()
