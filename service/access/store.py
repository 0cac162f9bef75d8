"""Everything of access in memory, written through to the database: first there, and where that fails nothing changed.

Reading takes no lock and no database: a request is let in, and a beam held, while the database hangs. Whoever changes
something holds `changing` from looking to writing, so that two changes never start from the same state.
"""

import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict
from datetime import UTC, datetime, timedelta

from sqlalchemy import select
from sqlalchemy.orm import Session

from service import audit
from service.access.permissions import Permission, Role
from service.access.records import ApiKey, Attempts, Login, Record, User
from service.audit import Event
from service.db.base import Base
from service.db.engine import Database
from service.db.models import ApiKeyRow, AttemptsRow, LoginRow, UserRow

ROW_OF: dict[type[Record], type[Base]] = {User: UserRow, Login: LoginRow, ApiKey: ApiKeyRow, Attempts: AttemptsRow}


def wall_clock() -> datetime:
    """Return the time of day."""
    return datetime.now(UTC)


def steady_clock() -> Callable[[], datetime]:
    """Make a clock that begins with the time of day and goes on evenly, whatever is done to that meanwhile."""
    began, began_ns = wall_clock(), time.monotonic_ns()
    return lambda: began + timedelta(microseconds=(time.monotonic_ns() - began_ns) // 1000)


class AccessStore:
    """People, log-ins, keys and failed attempts."""

    def __init__(self, database: Database, now: Callable[[], datetime] | None = None) -> None:
        self._database = database
        self.now = now or steady_clock()
        """For how long: no step of the wall clock ends a log-in, or a lock, in the middle of a treatment."""
        self.wall = now or wall_clock
        """For dates that were agreed on: until when a key holds."""
        self.changing = threading.RLock()
        self.users: dict[str, User] = {}
        self.logins: dict[str, Login] = {}
        self.keys: dict[str, ApiKey] = {}
        self.attempts: dict[str, Attempts] = {}
        self.seen: dict[str, datetime] = {}
        """When a log-in or key was last used, by its key; newer than the record's, which is written now and then."""

    def load(self) -> None:
        """Read everything; at the start."""
        with self.changing, self._database.read() as db:
            self.users = {user.key: user for user in map(_user, db.scalars(select(UserRow)))}
            self.logins = {login.key: login for login in map(_login, db.scalars(select(LoginRow)))}
            self.keys = {key.key: key for key in map(_api_key, db.scalars(select(ApiKeyRow)))}
            self.attempts = {one.key: one for one in map(_attempts, db.scalars(select(AttemptsRow)))}

    def write(self, *, save: Iterable[Record] = (), drop: Iterable[Record] = (), event: Event | None = None) -> None:
        """Save and drop records and write the audit row in one transaction; then, and only then, in memory."""
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
                self._shelf(record).pop(record.key, None)
                self.seen.pop(record.key, None)
            for record in saved:
                self._shelf(record)[record.key] = record

    def logins_of(self, user: User) -> list[Login]:
        """List a person's log-ins, oldest first."""
        mine = [login for login in list(self.logins.values()) if login.user_key == user.key]
        return sorted(mine, key=lambda login: login.created_at)

    def seen_at(self, record: Login) -> datetime:
        """Return when a log-in was last used."""
        return max(record.seen_at, self.seen.get(record.key, record.seen_at))

    def _shelf(self, record: Record) -> dict[str, Record]:
        shelves: dict[type[Record], object] = {
            User: self.users,
            Login: self.logins,
            ApiKey: self.keys,
            Attempts: self.attempts,
        }
        return shelves[type(record)]  # type: ignore[return-value]  # each shelf holds its own kind


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
    scopes = frozenset(Permission(name) for name in row.scopes.split())
    return ApiKey(**_values(row) | {"scopes": scopes})  # type: ignore[arg-type]


def _attempts(row: AttemptsRow) -> Attempts:
    return Attempts(**_values(row))  # type: ignore[arg-type]
