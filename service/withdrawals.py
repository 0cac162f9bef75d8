"""How often permission was taken away from a session, counted in memory: before the engine is told, and once it was.

The audit's row comes after the hold, so that it says too late that something was decided; this says it at once. Only
ever grows while the process lives. It begins anew with a process, in which no session of an earlier one runs.
"""

import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager


class Withdrawals:
    """Counts for each session that ran."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()

    def count(self, session_id: str) -> int:
        """Return the count; another one than before means that a look from before is no longer worth anything."""
        return self._counts[session_id]

    @contextmanager
    def one(self, session_id: str) -> Iterator[None]:
        """Take permission away: whoever looked before, or looks meanwhile, has to look again."""
        self._raise(session_id)
        try:
            yield
        finally:
            self._raise(session_id)

    def _raise(self, session_id: str) -> None:
        with self._lock:
            self._counts[session_id] += 1
