"""Builds the access objects at start-up and closes them at shutdown."""

from dataclasses import dataclass
from datetime import timedelta
from functools import partial

from service.access.accounts.passwords import Argon2Hashing, Hashing, PasswordService
from service.access.accounts.people import AccountService
from service.access.accounts.records import User
from service.access.accounts.store import AccessStore
from service.access.housekeeping import AccessCleanupWorker
from service.access.login.cookies import CookieScope
from service.access.login.keys import KeyService
from service.access.login.logins import Attempt, LoginService
from service.access.login.refusals import RefusedLogins
from service.access.request.authenticator import Authenticator
from service.access.request.identity import Identity
from service.access.screens.screens import ScreenService
from service.core.errors import LoginFailedError, SecondPersonError
from service.core.permissions import Permission, permissions_of
from service.core.settings.access import AccessSettings
from service.storage.audit.log import AuditLog
from service.storage.database.engine import Database


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
