"""A log handler that does not block: lines go into a bounded queue, and a thread of its own writes them.

Standard error may be a pipe whose reader has stopped. A blocking write to it would stop the event loop, and with it
every call to hold a beam. Lines that do not fit the queue are dropped and counted.
"""

import contextlib
import logging
import queue
import sys
import threading
from typing import TextIO

MOST_LINES = 4096
FLUSH_S = 0.3
"""Longest wait for the last lines when the process ends."""


class NonblockingHandler(logging.Handler):
    """Formats in the calling thread, whose context holds the request, and writes in its own."""

    def __init__(self, stream: TextIO | None = None, *, most_lines: int = MOST_LINES) -> None:
        super().__init__()
        self._stream = stream or sys.stderr
        self._lines: queue.Queue[str | threading.Event] = queue.Queue(most_lines)
        self.dropped = 0
        self._thread = threading.Thread(target=self._write_lines, name="tidegate-log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        """Queue a line; never blocks."""
        try:
            self._lines.put_nowait(self.format(record))
        except queue.Full:
            self.dropped += 1
        except Exception:  # noqa: BLE001 - a log line that fails must not fail its caller
            self.dropped += 1

    def flush(self) -> None:
        """Wait until the lines queued so far are written, for at most ``FLUSH_S``."""
        if not self._thread.is_alive() or threading.current_thread() is self._thread:
            return
        written = threading.Event()
        with contextlib.suppress(queue.Full):
            self._lines.put_nowait(written)
            written.wait(FLUSH_S)

    def _write_lines(self) -> None:
        while True:
            self._write(self._lines.get())

    def _write(self, line: str | threading.Event) -> None:
        if isinstance(line, threading.Event):
            line.set()
            return
        with contextlib.suppress(OSError, ValueError):  # the reader has gone, or the stream is closed
            self._stream.write(f"{line}\n")
            self._stream.flush()


def dropped_lines() -> int:
    """Return the number of lines dropped since the start."""
    return sum(one.dropped for one in logging.getLogger().handlers if isinstance(one, NonblockingHandler))


def flush_log() -> None:
    """Write the queued lines, before the process ends without its regular exit."""
    for one in logging.getLogger().handlers:
        one.flush()
