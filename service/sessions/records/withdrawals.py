"""Counts of the commands that took permission away from a session: holds, disarms and stops, kept in memory.

Their audit rows are written after the command, too late for the session's ETag; these counts change before the engine
receives the command, and again once it is executed. They never decrease while the process runs and start at 0 with it.
"""

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager


class Withdrawals:
    """Number of holds, disarms and stops per session; changes the ETag."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def count(self, session_id: str) -> int:
        """Return the count; a changed count makes an earlier ETag of the session invalid."""
        return self._counts[session_id]

    @contextmanager
    def one(self, session_id: str) -> Iterator[None]:
        """Count before and after the body: an ETag read before or during it does not match afterwards."""
        self._increment(session_id)
        try:
            yield
        finally:
            self._increment(session_id)

    def _increment(self, session_id: str) -> None:
        with self._lock:
            self._counts[session_id] += 1
