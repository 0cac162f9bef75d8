"""The service's periodic work: one daemon thread that repeats a turn until it is stopped.

Work that must not wait for other work gets a worker of its own. A turn that fails in a foreseen way is repeated; any
other error ends the thread, which `has_ended` reports and the readiness shows.
"""

import logging
import threading
from collections.abc import Callable

logger = logging.getLogger(__name__)


class PeriodicWorker:
    """Repeats ``turn`` in a thread of its own.

    Parameters
    ----------
    turn
        One round of work; may return how long to wait for the next one [s], instead of ``interval_s``.
    interval_s
        The wait between two turns [s].
    first_wait_s
        The wait before the first turn [s]; ``interval_s`` unless given.
    last
        Done once in the thread, after the worker was stopped.
    recoverable
        Errors after which the turn is repeated; logged once until a turn succeeds.
    """

    def __init__(
        self,
        name: str,
        turn: Callable[[], float | None],
        *,
        interval_s: float,
        first_wait_s: float | None = None,
        last: Callable[[], float | None] | None = None,
        recoverable: tuple[type[Exception], ...] = (),
    ) -> None:
        self._turn = turn
        self._interval_s = interval_s
        self._first_wait_s = interval_s if first_wait_s is None else first_wait_s
        self._last = last
        self._recoverable = recoverable
        self._failed: type[Exception] | None = None
        self._is_stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    @property
    def has_ended(self) -> bool:
        """Whether the thread has ended although the worker was not stopped."""
        return self._thread.ident is not None and not self._thread.is_alive() and not self._is_stopped.is_set()

    @property
    def trouble(self) -> str | None:
        """A sentence for the readiness where the thread has ended by itself."""
        return f"the thread {self._thread.name} has ended: see the service's log" if self.has_ended else None

    def start(self) -> None:
        """Start the thread; once."""
        self._thread.start()

    def stop(self, timeout_s: float) -> None:
        """Stop after the present turn and the last one; a thread that takes longer than the timeout [s] is left."""
        self._is_stopped.set()
        if self._thread.ident is not None:
            self._thread.join(timeout_s)

    def _run(self) -> None:
        wait_s = self._first_wait_s
        while not self._is_stopped.wait(wait_s):
            wait_s = self._try(self._turn)
        if self._last is not None:
            self._try(self._last)

    def _try(self, turn: Callable[[], float | None]) -> float:
        try:
            wait_s = turn()
        except self._recoverable as error:
            if self._failed is not type(error):
                logger.warning("%s: %s", self._thread.name, type(error).__name__)
            self._failed = type(error)
            return self._interval_s
        self._failed = None
        return self._interval_s if wait_s is None else wait_s
