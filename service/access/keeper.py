"""A thread that tidies up: refusals go to the audit, log-ins that are over go, times of last use are kept.

Nobody waits for it. Where the database does not take something, it is tried again at the next round.
"""

import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from datetime import timedelta

from sqlalchemy.exc import SQLAlchemyError

from service.access import lockout
from service.access.ledger import RefusalLedger
from service.access.records import ApiKey, Login, Record
from service.access.store import AccessStore
from service.audit import Event

logger = logging.getLogger(__name__)
ROUND_S = 1.0
ROUNDS_A_MINUTE = 60


class Keeper:
    """Makes its rounds until it is closed."""

    def __init__(
        self, store: AccessStore, ledger: RefusalLedger, write: Callable[[Event], None], *, idle: timedelta
    ) -> None:
        self._store = store
        self._ledger = ledger
        self._write = write
        self._idle = idle
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="access-keeper", daemon=True)

    @property
    def has_ended(self) -> bool:
        """Whether it makes no rounds any more although nobody closed it."""
        return self._thread.ident is not None and not self._thread.is_alive() and not self._is_over.is_set()

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def close(self) -> None:
        """End, and write down what is still due."""
        self._is_over.set()
        self._thread.join(ROUND_S * 10)
        self.write_refusals()
        self.write_summary()
        self.tidy()

    def write_refusals(self) -> None:
        """Write a row for each refusal of somebody known."""
        events = self._ledger.take_events()
        for place, event in enumerate(events):
            try:
                self._write(event)
            except SQLAlchemyError:
                self._ledger.give_back(events[place:])
                return

    def write_summary(self) -> None:
        """Write one row of how many were refused whom nobody knows."""
        summary = self._ledger.take_summary()
        if summary is not None:
            with suppress(SQLAlchemyError):
                self._write(summary)

    def tidy(self) -> None:
        """Drop what is over, keep when the rest was last used."""
        with suppress(SQLAlchemyError), self._store.changing:
            self._store.write(save=self._used(), drop=self._over())

    def _used(self) -> list[Record]:
        used: list[Record] = []
        for key, at in list(self._store.seen.items()):
            record = self._store.logins.get(key) or self._store.keys.get(key)
            if isinstance(record, Login) and record.seen_at < at and not self._is_done(record):
                used.append(replace(record, seen_at=at))
            elif isinstance(record, ApiKey) and record.last_used_at != at:
                used.append(replace(record, last_used_at=at))
        return used

    def _over(self) -> list[Record]:
        now = self._store.now()
        logins = [login for login in self._store.logins.values() if self._is_done(login)]
        forgotten = [one for one in self._store.attempts.values() if lockout.is_forgotten(one, now)]
        return [*logins, *forgotten]

    def _is_done(self, login: Login) -> bool:
        now = self._store.now()
        return now >= login.expires_at or now - self._store.seen_at(login) > self._idle

    def _run(self) -> None:
        rounds = 0
        while not self._is_over.wait(ROUND_S):
            rounds += 1
            self.write_refusals()
            if rounds % ROUNDS_A_MINUTE == 0:
                self.write_summary()
                self.tidy()
