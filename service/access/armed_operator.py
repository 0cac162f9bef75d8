"""Holds the beam when the operator who armed the gate is no longer logged in.

The gate itself needs no log-in to decide, but an armed gate needs an operator who can hold or disarm it. The engine
names that operator (``armed_by``). When their log-in or key ends, the beam is held with the same command as a manual
hold. Another operator with permission to arm continues by releasing the hold.
"""

import logging
from collections.abc import Callable
from typing import Protocol

from service.core.periodic import PeriodicWorker

logger = logging.getLogger(__name__)
INTERVAL_S = 1.0


class Armed(Protocol):
    """A session whose gate is armed and not held by hand."""

    @property
    def session_id(self) -> str:
        """The session."""

    @property
    def armed_by(self) -> str:
        """The audit's actor who armed, or released a hold since."""


class ArmedOperator:
    """Checks the armed operator once a second.

    It has its own thread because the other periodic workers may block on the database, which must not delay a hold.

    Parameters
    ----------
    is_present
        Whether an actor is still logged in and may arm; from memory, without I/O.
    armed
        Returns the running session whose gate is armed and not held by hand, as the newest view shows it; else None.
    hold
        Holds the beam of a session on behalf of the actor; may raise, then it is called again.
    """

    def __init__(
        self,
        *,
        is_present: Callable[[str], bool],
        armed: Callable[[], Armed | None],
        hold: Callable[[str, str], None],
    ) -> None:
        self._is_present = is_present
        self._armed = armed
        self._hold = hold
        self._worker = PeriodicWorker("armed-operator", self._turn, interval_s=INTERVAL_S)

    @property
    def has_ended(self) -> bool:
        """Whether the worker thread has ended without `close`."""
        return self._worker.has_ended

    def start(self) -> None:
        """Start the worker thread."""
        self._worker.start()

    def close(self) -> None:
        """Stop the worker thread; wait for it at most ten intervals."""
        self._worker.stop(INTERVAL_S * 10)

    def check(self) -> None:
        """Hold an armed gate whose operator is no longer logged in; a hold that fails is repeated at the next call."""
        armed = self._armed()
        if armed is not None and not self._is_present(armed.armed_by):
            self._hold(armed.session_id, armed.armed_by)

    def _turn(self) -> None:
        try:
            self.check()
        except Exception:  # the next turn tries again
            logger.warning("the gate could not be held although its operator is not logged in", exc_info=True)
