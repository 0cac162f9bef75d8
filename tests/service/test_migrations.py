"""Migrations: up and down with data in the tables, the same tables as the models, whole or not at all."""

import sqlite3

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from service import audit
from service.audit import Event
from service.db.base import Base
from service.db.engine import Database

TABLES = {"calibrations", "sessions", "samples", "models", "audit", "idempotency_keys"}
QA_TABLES = {"qa_runs", "qa_outcomes", "qa_results", "qa_baselines"}


@pytest.fixture
def database(tmp_path):
    database = Database(tmp_path / "migrated.db")
    yield database
    database.close()


def names(database, kind):
    raw = sqlite3.connect(database.path)
    found = {name for (name,) in raw.execute("SELECT name FROM sqlite_master WHERE type = ?", (kind,))}
    raw.close()
    return {name for name in found if not name.startswith("sqlite_")}


def fill(database):
    raw = sqlite3.connect(database.path)
    raw.execute("INSERT INTO calibrations VALUES ('c', 'h', 'cam', '{}', 'me', '2026-01-01T00:00:00.000000Z')")
    raw.execute(
        "INSERT INTO sessions VALUES ('s', 'ended', '', 'P', '1', '1', NULL, 'me', '{}', '{}', 'c', 1, NULL, "
        "'2026-01-01T00:00:00.000000Z', NULL, NULL, '{}', NULL)"
    )
    raw.execute(
        "INSERT INTO samples (session_id, frame_index, timestamp_us, missed_frames, state, gate, line_on, received_ns, "
        "decided_ns, asserted_ns) VALUES ('s', 0, 0, 0, 'lost', 'hold', 0, 0, 0, 0)"
    )
    raw.execute("INSERT INTO models VALUES ('m', 's', 1, 'h', '[]', 3, '2026-01-01T00:00:00.000000Z', '{}')")
    raw.execute("INSERT INTO qa_baselines VALUES (1, '{}', 'me', 'new camera', '2026-01-01T00:00:00.000000Z')")
    raw.execute(
        "INSERT INTO qa_runs VALUES ('q', 'daily', 'me', 'S', 'M', '{}', 0, 1, NULL, '{}', 1, '0', "
        "'2026-01-01T00:00:00.000000Z')"
    )
    raw.execute("INSERT INTO qa_results VALUES ('q', 'x', 0, NULL, 'mm', NULL, NULL, NULL, 1.0, 2.0, 'fail', '')")
    raw.execute(
        "INSERT INTO qa_outcomes VALUES ('q', 'finished', '', 'fail', '{}', 'h', '2026-01-01T00:00:00.000000Z')"
    )
    raw.execute("INSERT INTO idempotency_keys VALUES ('r', 'k', 'h', '{}', '2026-01-01T00:00:00.000000Z')")
    raw.commit()
    raw.close()
    with database.write() as db:
        audit.append(db, Event(actor="me", action="test"))


def test_the_first_start_makes_the_tables_in_wal_mode(database):
    database.migrate()
    assert names(database, "table") == TABLES | QA_TABLES | {"alembic_version"}
    assert len(names(database, "trigger")) == 6 + 13
    with database.connect() as connection:
        pragmas = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
        }
    assert pragmas == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 5000}


def test_migrations_and_models_describe_the_same_tables(database):
    database.migrate()
    with database.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []


def test_a_filled_database_goes_down_to_nothing_and_up_again(database):
    database.migrate()
    fill(database)
    database.downgrade("base")
    assert names(database, "table") == {"alembic_version"}
    assert names(database, "trigger") == set()
    database.migrate()
    fill(database)
    with database.read() as db:
        assert audit.verify(db).rows == 1


def test_migrating_again_keeps_the_data(database):
    database.migrate()
    fill(database)
    database.migrate()
    with database.read() as db:
        assert audit.verify(db).rows == 1


def test_a_migration_that_fails_halfway_leaves_nothing_behind(database):
    raw = sqlite3.connect(database.path)
    raw.execute("CREATE TABLE audit (stray INTEGER)")
    raw.close()
    with pytest.raises(Exception, match="audit already exists"):
        database.migrate()
    assert names(database, "table") - {"alembic_version"} == {"audit"}


def test_a_sample_needs_its_session(database):
    database.migrate()
    from sqlalchemy import text
    from sqlalchemy.exc import IntegrityError

    with pytest.raises(IntegrityError, match="FOREIGN KEY"), database.write() as db:
        db.execute(
            text(
                "INSERT INTO samples (session_id, frame_index, timestamp_us, missed_frames, state, gate, line_on, "
                "received_ns, decided_ns, asserted_ns) VALUES ('absent', 0, 0, 0, 'lost', 'hold', 0, 0, 0, 0)"
            )
        )
