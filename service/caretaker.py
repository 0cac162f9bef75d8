"""The thread that removes what is older than the site keeps it: at start, and every hour, never beside a session."""

import logging
import threading
from collections.abc import Callable
from datetime import UTC, datetime

from sqlalchemy.exc import SQLAlchemyError

from service.db.engine import Database
from service.idempotency import forget_answers
from service.retention import Holding, remove_old
from service.settings import Settings

logger = logging.getLogger(__name__)

EVERY_S = 3600.0
AGAIN_S = 60.0
JOIN_S = 1.0
"""A large file that is being hashed is not waited for: it is removed another day."""


class Caretaker(threading.Thread):
    """Removes old files; a session that runs has the disk to itself, and is waited for.

    Parameters
    ----------
    is_busy
        Whether a session runs.
    first
        What is done once, before: it may take a while, and nobody waits for it.
    """

    def __init__(
        self,
        database: Database,
        settings: Settings,
        *,
        is_busy: Callable[[], bool],
        first: Callable[[], object] = lambda: None,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        super().__init__(name="tidegate-caretaker", daemon=True)
        self._database = database
        self._settings = settings
        self._is_busy = is_busy
        self._first: Callable[[], object] | None = first
        self._now = now
        self._is_over = threading.Event()
        self._one_at_a_time = threading.Lock()

    @property
    def has_ended(self) -> bool:
        """Whether it looks no more although nobody closed it."""
        return self.ident is not None and not self.is_alive() and not self._is_over.is_set()

    def run(self) -> None:
        """Look, and look again."""
        wait_s = 0.0
        while not self._is_over.wait(wait_s):
            wait_s = self._turn()

    def tidy(self) -> list[Holding]:
        """Remove what may go, now; from any thread."""
        with self._one_at_a_time:
            forget_answers(self._database, days=self._settings.idempotency_days, now=self._now())
            return remove_old(self._database, self._settings.data_dir, self._settings, self._now())

    def close(self) -> None:
        """End; what is being removed is removed, if that takes no longer than somebody waits."""
        self._is_over.set()
        if self.is_alive():
            self.join(JOIN_S)

    def _turn(self) -> float:
        """Do one turn; return when the next is due [s]."""
        if self._is_busy():
            return AGAIN_S
        try:
            if self._first is not None:
                self._first()
                self._first = None
            self.tidy()
        except (SQLAlchemyError, OSError) as error:
            logger.warning("old files could not be removed: %s", type(error).__name__)
            return AGAIN_S
        return EVERY_S
