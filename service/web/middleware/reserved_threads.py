"""Worker threads reserved for hold, disarm and stop, so that these calls never wait behind reads.

All other calls share the event loop's forty threads, which hundreds of reads can occupy for seconds. A call in a
reserved thread waits only for other holds, disarms and stops, each of which commands the engine first. A call without
a running session uses the shared threads, so that it cannot delay a hold.
"""

from collections.abc import Callable
from typing import TypeVar

import anyio
import anyio.to_thread

AnswerT = TypeVar("AnswerT")
THREADS = 8
"""Fewer than the reserved database connections, so that these threads never wait for each other's connection."""


class ReservedThreads:
    """Runs calls in reserved threads, with the context variables of their request."""

    def __init__(self) -> None:
        self._limiter = anyio.CapacityLimiter(THREADS)

    async def run(self, call: Callable[[], AnswerT], *, takes: bool) -> AnswerT:
        """Run a call in a reserved thread if it ``takes`` the beam away, else in a shared one."""
        return await anyio.to_thread.run_sync(call, limiter=self._limiter if takes else None)
