"""Migrations: up and down with data in the tables, the same tables as the models, whole or not at all; on both."""

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import inspect, text
from sqlalchemy.exc import IntegrityError

from service.storage.database import migrations
from service.storage.database.base import Base
from service.storage.database.engine import Database
from service.storage.database.migrations import MigrationError, losses, schema_status
from tests.support.database.rows import add_rows, contents, shared
from tests.support.database.second_revision import FIRST, SECOND

pytestmark = [pytest.mark.both_databases, pytest.mark.slow]


@pytest.fixture
def database(empty_place):
    database = Database(empty_place)
    yield database
    database.close()


def names(database):
    with database.connect() as connection:
        return set(inspect(connection).get_table_names())


def triggers(database):
    catalog = "pg_trigger WHERE NOT tgisinternal" if database.is_postgresql else "sqlite_master WHERE type = 'trigger'"
    with database.connect() as connection:
        return connection.scalar(text(f"SELECT count(*) FROM {catalog}"))


def fill(database):
    with database.write() as db:
        add_rows(db.connection())


def rows(database):
    with database.connect() as connection:
        return contents(connection)


def test_the_first_start_makes_the_tables(database):
    database.migrate()
    assert names(database) == set(Base.metadata.tables) | {"alembic_version"}
    assert triggers(database) >= 15


def test_a_connection_to_the_file_is_in_wal_mode_and_loses_nothing(tmp_path):
    database = Database(tmp_path / "made.db")
    with database.connect() as connection:
        pragmas = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
        }
    database.close()
    assert pragmas == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 5000}


def test_migrations_and_models_describe_the_same_tables(database):
    database.migrate()
    with database.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []


@pytest.mark.usefixtures("second")
def test_rows_of_every_revision_survive_every_step_up_and_every_step_down(database):
    before, revisions = {}, list(migrations.titles())
    assert len(revisions) > 1
    for revision in revisions:
        database.migrate(revision)
        after = rows(database)
        assert before.keys() <= after.keys()
        kept, now = shared(before, after)
        assert now == kept, revision
        fill(database)
        before = rows(database)
    for revision in [*reversed(revisions[:-1]), "base"]:
        database.downgrade(revision)
        after = rows(database)
        kept, now = shared(before, after)
        assert now == kept, revision
        before = after
    assert names(database) == {"alembic_version"}
    assert triggers(database) == 0
    database.migrate()
    fill(database)


def test_nothing_of_a_trigger_stays_behind_on_the_way_down(database):
    database.migrate()
    database.downgrade("base")
    if database.is_postgresql:
        with database.connect() as connection:
            query = "SELECT count(*) FROM pg_proc WHERE pronamespace = 'public'::regnamespace"
            assert connection.scalar(text(query)) == 0
    database.migrate()


def test_migrating_again_keeps_the_data(database):
    database.migrate()
    fill(database)
    before = rows(database)
    database.migrate()
    assert rows(database) == before


def test_a_migration_that_fails_halfway_leaves_nothing_behind(database):
    with database.write() as db:
        db.execute(text("CREATE TABLE audit (stray INTEGER)"))
    with pytest.raises(Exception, match="audit"):
        database.migrate()
    assert names(database) - {"alembic_version"} == {"audit"}


def test_tables_of_a_newer_version_are_refused_in_plain_words_and_left_alone(database):
    database.migrate()
    with database.write() as db:
        db.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    for change in (database.migrate, lambda: database.downgrade("base")):
        with pytest.raises(MigrationError, match="revision 9999, made by a newer version of Tidegate"):
            change()


@pytest.mark.usefixtures("second")
def test_where_a_database_stands_is_reported_with_what_is_still_to_come(database):
    with database.connect() as connection:
        assert schema_status(connection).ahead == ("0001", "0002", FIRST, SECOND)
        assert schema_status(connection).revision is None
    database.migrate(FIRST)
    with database.connect() as connection:
        assert schema_status(connection).ahead == (SECOND,)


@pytest.mark.usefixtures("second")
def test_what_a_way_down_would_lose_is_named_with_its_numbers(database):
    database.migrate()
    fill(database)
    fill(database)
    with database.connect() as connection:
        assert losses(connection, SECOND) == []
        assert sorted(losses(connection, FIRST)) == ["made_up: 2 rows", "sessions.made_up: 2 values"]


@pytest.mark.usefixtures("second")
def test_columns_that_hold_nothing_but_their_default_lose_nothing(database):
    database.migrate(FIRST)
    fill(database)
    database.migrate(SECOND)
    with database.connect() as connection:
        assert losses(connection, FIRST) == []


def test_a_row_needs_the_row_it_belongs_to(database):
    database.migrate()
    fill(database)
    with pytest.raises(IntegrityError, match=r"(?i)foreign key"), database.write() as db:
        db.execute(text("UPDATE sessions SET calibration_id = 'absent'"))


def test_the_names_of_the_files_are_the_revisions_in_alembic_s_order():
    """A start compares the names alone, and does not load Alembic."""
    assert migrations._revisions() == [script.revision for script in migrations._scripts()]
