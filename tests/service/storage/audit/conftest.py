"""A database with a short chain in it, and ways to do to it what no one may."""

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from service.storage.database.engine import Database

TRIGGERS = ("audit_no_update", "audit_no_delete", "audit_only_next")


@pytest.fixture
def database(tmp_path: Path, filled_file: Path) -> Iterator[Database]:
    with closing(Database(shutil.copyfile(filled_file, tmp_path / "audit.db"))) as database:
        yield database


@pytest.fixture
def raw(tmp_path: Path, database: Database) -> Iterator[sqlite3.Connection]:
    """The file itself, without triggers, which its owner can drop."""
    connection = sqlite3.connect(tmp_path / "audit.db")
    for trigger in TRIGGERS:
        connection.execute(f"DROP TRIGGER {trigger}")
    connection.commit()
    yield connection
    connection.close()
