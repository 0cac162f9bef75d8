"""Whether whoever armed a gate is still there: if not, the beam is held, as by hand.

A log-in that ends turns nothing on, and a gate needs no log-in to decide; but an armed one belongs to somebody who can
take it back. Another who may arm goes on with it by releasing the hold.
"""

import logging
import threading
from collections.abc import Callable

from service.access.identity import Identity

logger = logging.getLogger(__name__)
ROUND_S = 1.0


class Attendance:
    """Looks every second; a thread of its own, for others may wait for a database, and a hold does not."""

    def __init__(
        self,
        *,
        is_here: Callable[[Identity], bool],
        is_armed: Callable[[str], bool],
        hold: Callable[[str, Identity], None],
    ) -> None:
        self._is_here = is_here
        self._is_armed = is_armed
        self._hold = hold
        self._answers: tuple[str, Identity] | None = None
        self._held_for: tuple[str, Identity] | None = None  # set by who looks alone: what others set is never lost
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="attendance", daemon=True)

    def answers_for(self, session_id: str, identity: Identity) -> None:
        """Hear who armed, or released a hold: the newest answers for the gate."""
        self._answers = (session_id, identity)

    @property
    def has_ended(self) -> bool:
        """Whether nobody looks any more although nobody said so."""
        return self._thread.ident is not None and not self._thread.is_alive() and not self._is_over.is_set()

    def start(self) -> None:
        """Begin to look."""
        self._thread.start()

    def close(self) -> None:
        """Stop looking."""
        self._is_over.set()
        self._thread.join(ROUND_S * 10)

    def look(self) -> None:
        """Hold where nobody answers for an armed gate any more; once, until somebody does again.

        A gate that does not show armed is looked at again: an arming may not be in the newest frame yet, or come true
        after its asker was told that it did not come in time. A hold that fails is tried again.
        """
        answers = self._answers
        if answers is None or answers is self._held_for:
            return
        if self._is_armed(answers[0]) and not self._is_here(answers[1]):
            self._hold(*answers)
            self._held_for = answers

    def _run(self) -> None:
        while not self._is_over.wait(ROUND_S):
            try:
                self.look()
            except Exception:
                logger.warning("the gate could not be held although nobody answers for it", exc_info=True)
