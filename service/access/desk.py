"""Everything of access in one place, made at the start and closed at the end."""

from dataclasses import dataclass
from datetime import timedelta

from service.access.doorkeeper import Doorkeeper
from service.access.identity import Identity
from service.access.keeper import Keeper
from service.access.keys import KeyDesk
from service.access.ledger import RefusalLedger
from service.access.logins import LoginDesk
from service.access.passwords import Argon2Hashing, Hashing, PasswordDesk
from service.access.people import PeopleDesk
from service.access.records import User
from service.access.store import AccessStore
from service.access_settings import AccessSettings
from service.audit_log import AuditLog
from service.db.engine import Database


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class AccessDesk:
    """What routers and the guard ask."""

    store: AccessStore
    logins: LoginDesk
    people: PeopleDesk
    keys: KeyDesk
    doorkeeper: Doorkeeper
    ledger: RefusalLedger
    passwords: PasswordDesk
    keeper: Keeper
    is_secure: bool

    def person(self, identity: Identity) -> User:
        """Return the person behind an identity that `is_person`."""
        return self.people.get(identity.name)

    def close(self) -> None:
        """Write down what is still due; from now on nobody is let in by a password."""
        self.passwords.close()
        self.keeper.close()


def open_access(
    database: Database, log: AuditLog, settings: AccessSettings, hashing: Hashing | None = None
) -> AccessDesk:
    """Read everything, and begin to keep it."""
    store = AccessStore(database)
    store.load()
    hashing = hashing or Argon2Hashing()
    ledger, passwords = RefusalLedger(), PasswordDesk()
    idle = timedelta(minutes=settings.login_idle_min)
    keys = KeyDesk(store, longest=timedelta(days=settings.key_max_days))
    keeper = Keeper(store, ledger, log.write, idle=idle)
    keeper.start()
    return AccessDesk(
        store=store,
        logins=LoginDesk(store, hashing, ledger, lasts=timedelta(hours=settings.login_hours), idle=idle),
        people=PeopleDesk(store, lambda password: passwords.submit(lambda: hashing.hash(password)).result()),
        keys=keys,
        doorkeeper=Doorkeeper(store, keys, idle=idle, is_secure=settings.is_secure),
        ledger=ledger,
        passwords=passwords,
        keeper=keeper,
        is_secure=settings.is_secure,
    )
