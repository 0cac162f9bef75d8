"""All access records in memory, written through: to the database first; if that fails, memory is unchanged.

Reads take neither lock nor database, so requests are authenticated and a beam is held while the database hangs. A
change holds `changing` from its first read to its write, so that two changes never start from the same state.
"""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from datetime import UTC, datetime, timedelta

from sqlalchemy import select
from sqlalchemy.orm import Session

from service.access.accounts.records import ApiKey, Attempts, Login, Record, User
from service.core.permissions import KEY_PERMISSIONS, Permission, Role
from service.storage import audit
from service.storage.audit import Event
from service.storage.database.base import Base
from service.storage.database.engine import Database
from service.storage.database.tables import ApiKeyRow, AttemptsRow, LoginRow, UserRow

ROW_OF: dict[type[Record], type[Base]] = {User: UserRow, Login: LoginRow, ApiKey: ApiKeyRow, Attempts: AttemptsRow}


def wall_clock() -> datetime:
    """Return the current UTC time of the system clock."""
    return datetime.now(UTC)


def steady_clock() -> Callable[[], datetime]:
    """Return a clock that starts at the current UTC time and advances monotonically, unaffected by clock changes."""
    start, start_ns = wall_clock(), time.monotonic_ns()
    return lambda: start + timedelta(microseconds=(time.monotonic_ns() - start_ns) // 1000)


class AccessStore:
    """Users, log-ins, API keys and failed attempts, by their keys; load it before use.

    Any thread may read. Writes are serialised by `changing`.
    """

    def __init__(self, database: Database, now: Callable[[], datetime] | None = None) -> None:
        self._database = database
        self.now = now or steady_clock()
        """Monotonic time, for durations: a step of the system clock must not end a log-in during a treatment."""
        self.wall = now or wall_clock
        """System clock, for calendar dates such as the expiry of a key."""
        self.changing = threading.RLock()
        self.users: dict[str, User] = {}
        self.logins: dict[str, Login] = {}
        self.keys: dict[str, ApiKey] = {}
        self.attempts: dict[str, Attempts] = {}
        self.last_used: dict[str, datetime] = {}
        """Time of last use of a log-in or key, by its key; newer than in the record, which is saved once a minute."""

    def load(self) -> None:
        """Replace everything in memory by the database's rows; called once at start-up."""
        with self.changing, self._database.read() as db:
            self.users = {user.key: user for user in map(_user, db.scalars(select(UserRow)))}
            self.logins = {login.key: login for login in map(_login, db.scalars(select(LoginRow)))}
            self.keys = {key.key: key for key in map(_api_key, db.scalars(select(ApiKeyRow)))}
            self.attempts = {one.key: one for one in map(_attempts, db.scalars(select(AttemptsRow)))}

    def write(self, *, save: Iterable[Record] = (), drop: Iterable[Record] = (), event: Event | None = None) -> None:
        """Save and delete records and append the audit row in one transaction; change memory after its commit.

        Raises
        ------
        SQLAlchemyError
            The database did not take it; memory is unchanged.
        """
        saved, dropped = list(save), list(drop)
        with self.changing:
            with self._database.write() as db:
                for record in dropped:
                    _drop(db, record)
                db.flush()
                for record in saved:
                    _save(db, record)
                if event is not None:
                    audit.append(db, event)
            for record in dropped:
                self._records_like(record).pop(record.key, None)
                self.last_used.pop(record.key, None)
            for record in saved:
                self._records_like(record)[record.key] = record

    def logins_of(self, user: User) -> list[Login]:
        """List a user's log-ins, oldest first, expired ones included until the clean-up."""
        logins = [login for login in list(self.logins.values()) if login.user_key == user.key]
        return sorted(logins, key=lambda login: login.created_at)

    def last_used_at(self, record: Login) -> datetime:
        """Return the time of a log-in's last request."""
        return max(record.seen_at, self.last_used.get(record.key, record.seen_at))

    def _records_like(self, record: Record) -> dict[str, Record]:
        records: dict[type[Record], object] = {
            User: self.users,
            Login: self.logins,
            ApiKey: self.keys,
            Attempts: self.attempts,
        }
        return records[type(record)]  # type: ignore[return-value]  # each dictionary holds one record type


def _save(db: Session, record: Record) -> None:
    values: dict[str, object] = asdict(record)
    for name in ("roles", "scopes"):
        if name in values:
            values[name] = " ".join(sorted(getattr(record, name)))
    if isinstance(record, User):
        values["key"] = record.key
    db.merge(ROW_OF[type(record)](**values))


def _drop(db: Session, record: Record) -> None:
    row = db.get(ROW_OF[type(record)], record.key)
    if row is not None:
        db.delete(row)


def _values(row: Base) -> dict[str, object]:
    return {column.name: getattr(row, column.name) for column in row.__table__.columns}


def _user(row: UserRow) -> User:
    values = _values(row) | {"roles": frozenset(Role(name) for name in row.roles.split())}
    values.pop("key")
    return User(**values)  # type: ignore[arg-type]  # the row's columns are the record's fields


def _login(row: LoginRow) -> Login:
    return Login(**_values(row))  # type: ignore[arg-type]


def _api_key(row: ApiKeyRow) -> ApiKey:
    # Without what machines no longer may, so that lists and answers show what the key can do.
    scopes = frozenset(Permission(name) for name in row.scopes.split()) & KEY_PERMISSIONS
    return ApiKey(**_values(row) | {"scopes": scopes})  # type: ignore[arg-type]


def _attempts(row: AttemptsRow) -> Attempts:
    return Attempts(**_values(row))  # type: ignore[arg-type]
