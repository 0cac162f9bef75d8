"""A service on a fake engine, a store of its own, and a clock that a test sets."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from service.access.ledger import RefusalLedger
from service.access.logins import LoginDesk
from service.access.people import PeopleDesk
from service.access.store import AccessStore
from service.app import create_app
from service.db.engine import Database
from service.settings import Settings
from tests.service.conftest import with_tables
from tests.service.fakes import FakeEngine
from tests.service.people import PeopleClient, QuickHashing

IDLE = timedelta(minutes=30)
LASTS = timedelta(hours=12)


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
def ledger() -> RefusalLedger:
    return RefusalLedger()


@pytest.fixture
def logins(store: AccessStore, hashing: QuickHashing, ledger: RefusalLedger) -> LoginDesk:
    return LoginDesk(store, hashing, ledger, lasts=LASTS, idle=IDLE)


@pytest.fixture
def people(store: AccessStore, hashing: QuickHashing) -> PeopleDesk:
    return PeopleDesk(store, hashing.hash)


@pytest.fixture
def site(tmp_path: Path) -> Settings:
    (tmp_path / "recordings").mkdir()
    return Settings(data_dir=tmp_path / "data", allowed_hosts=("testserver",), command_timeout_s=0.2)


@pytest.fixture
def nobody(site: Settings, migrated_file: Path) -> Iterator[PeopleClient]:
    """A client that is nobody until it says who."""
    with PeopleClient(create_app(with_tables(site, migrated_file), lambda _settings: FakeEngine())) as client:
        client.speaks_as = None
        yield client
