"""Removes files older than the site's retention: at the start and every hour, never while a session runs."""

import logging
import threading
from collections.abc import Callable
from datetime import UTC, datetime

from sqlalchemy.exc import SQLAlchemyError

from service.core.periodic import PeriodicWorker
from service.core.settings.settings import Settings
from service.storage.database.engine import Database
from service.storage.database.idempotency import forget_answers
from service.storage.files.retention import Holding, remove_old

logger = logging.getLogger(__name__)

EVERY_S = 3600.0
AGAIN_S = 60.0
JOIN_S = 1.0
"""The stop does not wait longer for a large file being hashed; a later turn removes it [s]."""


class CleanupWorker:
    """Removes old files in a thread of its own; waits while a session runs, which has the disk to itself.

    Parameters
    ----------
    is_busy
        Whether a session runs.
    """

    def __init__(
        self,
        database: Database,
        settings: Settings,
        *,
        is_busy: Callable[[], bool],
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self._database = database
        self._settings = settings
        self._is_busy = is_busy
        self._now = now
        self._worker = PeriodicWorker("tidegate-cleanup", self._turn, interval_s=EVERY_S, first_wait_s=0.0)
        self._one_at_a_time = threading.Lock()

    @property
    def has_ended(self) -> bool:
        """Whether its thread has ended although it was not closed."""
        return self._worker.has_ended

    def start(self) -> None:
        """Start its thread; the first turn is at once."""
        self._worker.start()

    def tidy(self) -> list[Holding]:
        """Remove old files and old Idempotency-Keys now; from any thread."""
        with self._one_at_a_time:
            forget_answers(self._database, days=self._settings.idempotency_days, now=self._now())
            return remove_old(self._database, self._settings.data_dir, self._settings, self._now())

    def close(self) -> None:
        """Stop; a removal in progress is finished, unless that takes longer than `JOIN_S`."""
        self._worker.stop(JOIN_S)

    def _turn(self) -> float:
        """Do one turn; return the wait until the next [s]."""
        if self._is_busy():
            return AGAIN_S
        try:
            self.tidy()
        except (SQLAlchemyError, OSError) as error:
            logger.warning("old files could not be removed: %s", type(error).__name__)
            return AGAIN_S
        return EVERY_S
