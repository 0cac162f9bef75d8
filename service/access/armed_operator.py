"""Holds the beam when the operator who armed the gate is no longer logged in.

The gate itself needs no log-in to decide, but an armed gate needs an operator who can hold or disarm it. When the
operator's log-in or key ends, the beam is held with the same command as a manual hold. Another operator with permission
to arm continues by releasing the hold.
"""

import logging
from collections.abc import Callable

from service.access.request.identity import Identity
from service.core.periodic import PeriodicWorker

logger = logging.getLogger(__name__)
INTERVAL_S = 1.0


class ArmedOperator:
    """Checks the armed operator once a second.

    It has its own thread because the other periodic workers may block on the database, which must not delay a hold.

    Parameters
    ----------
    is_present
        Whether an identity is still logged in and may arm; from memory, without I/O.
    is_armed
        Whether the newest frame of a session shows an armed gate.
    hold
        Holds the beam of a session on behalf of the identity; may raise, then it is called again.
    """

    def __init__(
        self,
        *,
        is_present: Callable[[Identity], bool],
        is_armed: Callable[[str], bool],
        hold: Callable[[str, Identity], None],
    ) -> None:
        self._is_present = is_present
        self._is_armed = is_armed
        self._hold = hold
        self._operator: tuple[str, Identity] | None = None
        self._held_for: tuple[str, Identity] | None = None  # written by the worker thread only
        self._worker = PeriodicWorker("armed-operator", self._turn, interval_s=INTERVAL_S)

    def set_operator(self, session_id: str, identity: Identity) -> None:
        """Record who armed or released a hold; the newest replaces the one before. Called from any thread."""
        self._operator = (session_id, identity)

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
        """Hold an armed gate whose operator is no longer logged in; once per recorded operator.

        A gate that is not armed is checked again at the next call: the newest frame may precede the arm command, and
        an arm command may be executed after its request timed out. A hold that fails is repeated at the next call.
        """
        operator = self._operator
        if operator is None or operator is self._held_for:
            return
        if self._is_armed(operator[0]) and not self._is_present(operator[1]):
            self._hold(*operator)
            self._held_for = operator

    def _turn(self) -> None:
        try:
            self.check()
        except Exception:  # the next turn tries again
            logger.warning("the gate could not be held although its operator is not logged in", exc_info=True)
