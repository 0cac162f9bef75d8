"""A service on a fake engine, a store of its own, and a clock that a test sets."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from service.access.accounts.people import AccountService
from service.access.accounts.store import AccessStore
from service.access.login.lockout import RefusedLogins
from service.access.login.logins import LoginService
from service.access.screens.screens import ScreenService
from service.core.settings.settings import Settings
from service.storage.database.engine import Database
from service.web.app import create_app
from tests.support.access.login_times import IDLE, LASTS
from tests.support.database.migrated import with_tables
from tests.support.service.accounts import PeopleClient, QuickHashing
from tests.support.service.fake_engine import FakeEngine


class HandClock:
    """The wall clock, as a test has it."""

    def __init__(self) -> None:
        self.at = datetime(2026, 11, 21, 12, 0, tzinfo=UTC)

    def __call__(self) -> datetime:
        return self.at

    def go_on(self, **time: float) -> None:
        self.at += timedelta(**time)


@pytest.fixture
def clock() -> HandClock:
    return HandClock()


@pytest.fixture
def store(database: Database, clock: HandClock) -> AccessStore:
    return AccessStore(database, clock)


@pytest.fixture
def hashing() -> QuickHashing:
    return QuickHashing()


@pytest.fixture
def refused_logins() -> RefusedLogins:
    return RefusedLogins()


@pytest.fixture
def logins(store: AccessStore, hashing: QuickHashing, refused_logins: RefusedLogins) -> LoginService:
    return LoginService(store, hashing, refused_logins, lasts=LASTS, idle=IDLE)


@pytest.fixture
def people(store: AccessStore, hashing: QuickHashing) -> AccountService:
    return AccountService(store, hashing.hash)


@pytest.fixture
def screens(store: AccessStore, refused_logins: RefusedLogins) -> ScreenService:
    return ScreenService(store, refused_logins, lasts=LASTS, idle=IDLE)


@pytest.fixture
def site(tmp_path: Path) -> Settings:
    (tmp_path / "recordings").mkdir()
    return Settings(data_dir=tmp_path / "data", allowed_hosts=("testserver",))


@pytest.fixture
def anonymous(site: Settings, migrated_file: Path) -> Iterator[PeopleClient]:
    """A client that is no one until it says who."""
    with PeopleClient(create_app(with_tables(site, migrated_file), lambda _settings: FakeEngine())) as client:
        client.speaks_as = None
        yield client
