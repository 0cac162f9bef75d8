"""Builds the access objects at start-up and closes them at shutdown."""

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import timedelta
from functools import partial

from sqlalchemy.exc import SQLAlchemyError

from service.access.accounts.passwords import Argon2Hashing, Hashing, PasswordService
from service.access.accounts.people import AccountService
from service.access.accounts.records import ApiKey, Login, Record, User
from service.access.accounts.store import AccessStore
from service.access.login import lockout
from service.access.login.cookies import CookieScope
from service.access.login.keys import KeyService
from service.access.login.lockout import RefusedLogins
from service.access.login.logins import Attempt, LoginService
from service.access.request.authenticator import Authenticator
from service.access.request.identity import Identity
from service.access.screens.screens import ScreenService
from service.core.errors import LoginFailedError, SecondPersonError, SignerError
from service.core.periodic import PeriodicWorker
from service.core.permissions import Permission, permissions_of
from service.core.settings.access import AccessSettings
from service.storage.audit import Event
from service.storage.audit.log import AuditLog
from service.storage.database.engine import Database

logger = logging.getLogger(__name__)
INTERVAL_S = 1.0
ROUNDS_PER_MINUTE = 60
SIGNING_LOGIN = timedelta(minutes=5)
"""Age of the log-in with which a person of an identity provider signs a report."""


# Periodic work of access: write refusals to the audit, delete expired log-ins, save times of last use.
#
# Runs in one thread on which no request waits. A write that the database refuses is repeated in the next round.
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


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AccessService:
    """The objects behind log-in, accounts and API keys: one instance a service, in ``app.state.access``."""

    store: AccessStore
    logins: LoginService
    accounts: AccountService
    keys: KeyService
    screens: ScreenService
    authenticator: Authenticator
    refused_logins: RefusedLogins
    passwords: PasswordService
    cleanup_worker: AccessCleanupWorker
    cookies: CookieScope

    def person(self, identity: Identity) -> User:
        """Return the account of an identity that `is_person`; raise NotFoundError where there is none."""
        return self.accounts.get(identity.name)

    def second_person(self, attempt: Attempt, permission: Permission) -> str:
        """Verify a second person's password as a log-in does, and return the name; the log-in is ended at once.

        Raises
        ------
        SecondPersonError
            Name or password is wrong, the account is disabled, or the person lacks the permission.
        LockedOutError, LocalLoginRefusedError, PasswordServiceBusyError
            As for a log-in.
        """
        try:
            opened = self.passwords.submit(partial(self.logins.log_in, attempt)).result()
        except LoginFailedError as error:
            raise SecondPersonError("the second person's name or password is wrong") from error
        self.logins.log_out(opened.login)
        if opened.user.must_change_password or permission not in permissions_of(opened.user.roles):
            raise SecondPersonError(f"{opened.user.name} may not countersign: see the roles, and the password's age")
        return opened.user.name

    def confirm_signer(self, identity: Identity, password: str | None, address: str) -> str:
        """Confirm that who signs is who is logged in; return ``password`` or ``login``, or raise SignerError.

        People of an identity provider have no password here: their log-in was opened within `SIGNING_LOGIN`. Failures
        count, and are locked out, as those of a log-in.
        """
        if self.person(identity).issuer is not None:
            login = self.store.logins.get(identity.anchor or "")
            if login is None or self.store.now() - login.created_at > SIGNING_LOGIN:
                minutes = f"{SIGNING_LOGIN.total_seconds() / 60:g} minutes"
                raise SignerError(f"the log-in is older than {minutes}: log out and in again, then sign")
            return "login"
        if password is None:
            raise SignerError("a signature needs the password", field="password", bound="the person's own")
        attempt = Attempt(name=identity.name, password=password, address=address)
        try:
            self.passwords.submit(partial(self.logins.verify, attempt)).result()
        except LoginFailedError as error:
            raise SignerError("the password is wrong", field="password", bound="the person's own") from error
        return "password"

    def close(self) -> None:
        """Stop the password thread and the clean-up thread; write pending refusals and times of last use first."""
        self.passwords.close()
        self.cleanup_worker.close()


def open_access(
    database: Database, log: AuditLog, settings: AccessSettings, hashing: Hashing | None = None, *, room: str = ""
) -> AccessService:
    """Load all access records into memory and start the clean-up thread.

    Raises
    ------
    SQLAlchemyError
        The database cannot be read.
    """
    store = AccessStore(database)
    store.load()
    hashing = hashing or Argon2Hashing()
    refused_logins, passwords = RefusedLogins(), PasswordService()
    idle = timedelta(minutes=settings.login_idle_min)
    lasts = timedelta(hours=settings.login_hours)
    keys = KeyService(store, longest=timedelta(days=settings.key_max_days))
    screens = ScreenService(store, refused_logins, lasts=lasts, idle=idle)
    cleanup_worker = AccessCleanupWorker(store, refused_logins, log.write, idle=idle)
    cleanup_worker.start()
    cookies = CookieScope(is_secure=settings.is_secure, room=room)
    return AccessService(
        store=store,
        logins=LoginService(store, hashing, refused_logins, lasts=lasts, idle=idle),
        accounts=AccountService(store, lambda password: passwords.submit(lambda: hashing.hash(password)).result()),
        keys=keys,
        screens=screens,
        authenticator=Authenticator(store, keys, screens, idle=idle, cookies=cookies),
        refused_logins=refused_logins,
        passwords=passwords,
        cleanup_worker=cleanup_worker,
        cookies=cookies,
    )
