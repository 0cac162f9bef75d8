"""A database with a short chain in it, and ways to do to it what nobody may."""

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from service import audit
from service.audit import Event
from service.db.engine import Database

TRIGGERS = ("audit_no_update", "audit_no_delete", "audit_only_next")


def fill(database: Database, rows: int) -> None:
    with database.write() as db:
        for number in range(1, rows + 1):
            audit.append(db, Event(actor="me", action="test", detail={"number": number, "text": "Grüße ☢"}))


@pytest.fixture(scope="session")
def filled_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database with seven rows, made once: its tables cost more than most tests."""
    path = tmp_path_factory.mktemp("audit") / "filled.db"
    with closing(Database(path)) as database:
        database.migrate()
        fill(database, 7)
    return path


@pytest.fixture
def database(tmp_path: Path, filled_file: Path) -> Iterator[Database]:
    with closing(Database(shutil.copyfile(filled_file, tmp_path / "audit.db"))) as database:
        yield database


@pytest.fixture
def raw(tmp_path: Path, database: Database) -> Iterator[sqlite3.Connection]:
    """The file itself, with the triggers gone: whoever owns the file can do that."""
    connection = sqlite3.connect(tmp_path / "audit.db")
    for trigger in TRIGGERS:
        connection.execute(f"DROP TRIGGER {trigger}")
    connection.commit()
    yield connection
    connection.close()
