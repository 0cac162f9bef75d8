"""Threads of their own for calls that take permission away: they wait behind no read, however many there are.

All other calls share the event loop's forty threads, and hundreds of reads keep those for seconds. These few are not
shared; who takes one waits for other holds, disarmings and stops alone, each of which tells its engine first. A call
for which there is nothing to take away is like all others: it may have to wait, and must keep no hold out meanwhile.
"""

from collections.abc import Callable
from typing import TypeVar

import anyio
import anyio.to_thread

AnswerT = TypeVar("AnswerT")
THREADS = 8
"""Fewer than a database has connections for them: none of these threads waits for one that another has."""


class OwnThreads:
    """The threads; a call in one of them sees the context of its request, as in any other."""

    def __init__(self) -> None:
        self._limiter = anyio.CapacityLimiter(THREADS)

    async def run(self, call: Callable[[], AnswerT], *, takes: bool) -> AnswerT:
        """Make a call in one of the threads; where it ``takes`` nothing away, in one of those that all share."""
        return await anyio.to_thread.run_sync(call, limiter=self._limiter if takes else None)
