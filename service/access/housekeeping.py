"""Periodic work of access: write refusals to the audit, delete expired log-ins, save times of last use.

Runs in one thread on which no request waits. A write that the database refuses is repeated in the next round.
"""

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import timedelta

from sqlalchemy.exc import SQLAlchemyError

from service.access.accounts.records import ApiKey, Login, Record
from service.access.accounts.store import AccessStore
from service.access.login import lockout
from service.access.login.refusals import RefusedLogins
from service.core.periodic import PeriodicWorker
from service.storage.audit import Event

logger = logging.getLogger(__name__)
INTERVAL_S = 1.0
ROUNDS_PER_MINUTE = 60


class AccessCleanupWorker:
    """Writes refusals every second; summary and clean-up once a minute.

    Parameters
    ----------
    write
        Appends one event to the audit; raises SQLAlchemyError when the database fails.
    idle
        A log-in without a request for longer than this has expired.
    """

    def __init__(
        self, store: AccessStore, refused_logins: RefusedLogins, write: Callable[[Event], None], *, idle: timedelta
    ) -> None:
        self._store = store
        self._refused_logins = refused_logins
        self._write = write
        self._idle = idle
        self._rounds = 0
        self._worker = PeriodicWorker("access-cleanup", self._round, interval_s=INTERVAL_S)

    @property
    def has_ended(self) -> bool:
        """Whether the worker thread has ended without `close`."""
        return self._worker.has_ended

    def start(self) -> None:
        """Start the worker thread."""
        self._worker.start()

    def close(self) -> None:
        """Stop the worker thread, then write what is pending from the calling thread."""
        self._worker.stop(INTERVAL_S * 10)
        self.write_refusals()
        self.write_summary()
        self.delete_expired()

    def write_refusals(self) -> None:
        """Write one audit row for each pending refusal; after a failed write the rest is queued again."""
        events = self._refused_logins.take_events()
        for index, event in enumerate(events):
            try:
                self._write(event)
            except SQLAlchemyError:
                self._refused_logins.requeue(events[index:])
                return

    def write_summary(self) -> None:
        """Write one audit row with the counts of unidentified refusals; lost when the database does not take it."""
        summary = self._refused_logins.take_summary()
        if summary is not None:
            with suppress(SQLAlchemyError):
                self._write(summary)

    def delete_expired(self) -> None:
        """Delete expired log-ins and failure counts, and save the times of last use of the others."""
        with suppress(SQLAlchemyError), self._store.changing:
            self._store.write(save=self._recently_used(), drop=self._expired())

    def _recently_used(self) -> list[Record]:
        used: list[Record] = []
        for key, at in list(self._store.last_used.items()):
            record = self._store.logins.get(key) or self._store.keys.get(key)
            if isinstance(record, Login) and record.seen_at < at and not self._has_expired(record):
                used.append(replace(record, seen_at=at))
            elif isinstance(record, ApiKey) and record.last_used_at != at:
                used.append(replace(record, last_used_at=at))
        return used

    def _expired(self) -> list[Record]:
        now = self._store.now()
        logins = [login for login in self._store.logins.values() if self._has_expired(login)]
        attempts = [one for one in self._store.attempts.values() if lockout.has_lapsed(one, now)]
        return [*logins, *attempts]

    def _has_expired(self, login: Login) -> bool:
        now = self._store.now()
        return now >= login.expires_at or now - self._store.last_used_at(login) > self._idle

    def _round(self) -> None:
        self._rounds += 1
        self.write_refusals()
        if self._rounds % ROUNDS_PER_MINUTE == 0:
            self.write_summary()
            self.delete_expired()
