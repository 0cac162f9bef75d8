"""The database itself refuses what no one may do to what was written, by every statement there is for it."""

import sqlite3

import pytest

from tests.support.audit.rows import COLUMN, KEPT, ROWS


def insert(table: str, verb: str = "INSERT", **other: object) -> tuple[str, list[object]]:
    row = {**ROWS[table], **other}
    marks = ", ".join("?" * len(row))
    return f"{verb} INTO {table} ({', '.join(row)}) VALUES ({marks})", list(row.values())


@pytest.fixture
def filled(database):
    connection = sqlite3.connect(database.path)
    for table in ROWS:
        connection.execute(*insert(table))
    connection.commit()
    yield connection
    connection.close()


def contents(connection, table):
    return connection.execute(f"SELECT * FROM {table} ORDER BY 1").fetchall()


def refused(connection, table, statement, values=()):
    before = contents(connection, table)
    with pytest.raises(sqlite3.IntegrityError, match=r"append-only|next row only|has ended"):
        connection.execute(statement, values)
    connection.rollback()
    assert contents(connection, table) == before


@pytest.mark.parametrize("table", KEPT)
@pytest.mark.parametrize(
    "statement",
    [
        "UPDATE {0} SET {1} = 'you'",
        "UPDATE OR REPLACE {0} SET {1} = 'you'",
        "UPDATE {0} SET {1} = {1}",
        "DELETE FROM {0}",
        "DELETE FROM {0} WHERE rowid = 1",
    ],
)
def test_what_was_written_is_neither_changed_nor_removed(filled, table, statement):
    refused(filled, table, statement.format(table, COLUMN[table]))


@pytest.mark.parametrize("table", KEPT)
def test_no_insert_takes_the_place_of_a_row(filled, table):
    refused(filled, table, *insert(table, "INSERT OR REPLACE"))
    refused(filled, table, *insert(table, "REPLACE"))
    statement, values = insert(table)
    refused(filled, table, f"{statement} ON CONFLICT DO UPDATE SET {COLUMN[table]} = 'you'", values)


OTHER_KEYS = {
    "plans": {"id": "y" * 32, "sop_instance_uid": "1.2.4", "sha256": "f"},
    "calibrations": {"id": "y" * 32, "sha256": "d"},
    "models": {"id": "y" * 32, "number": 2},
    "qa_runs": {"id": "y" * 32},
    "qa_results": {"code": "d"},
    "qa_outcomes": {"run_id": "y" * 32},
}


@pytest.mark.parametrize("table", OTHER_KEYS)
def test_no_insert_takes_the_place_of_a_row_by_its_hidden_number(filled, table):
    filled.execute("PRAGMA foreign_keys=OFF")
    refused(filled, table, *insert(table, "INSERT OR REPLACE", rowid=1, **OTHER_KEYS[table]))


def test_another_calibration_plan_or_model_of_the_same_content_or_number_takes_no_place(filled):
    refused(filled, "calibrations", *insert("calibrations", "INSERT OR REPLACE", id="y" * 32))
    for other in ({"sha256": "f"}, {"sop_instance_uid": "1.2.4"}):
        refused(filled, "plans", *insert("plans", "INSERT OR REPLACE", id="y" * 32, **other))
    refused(filled, "models", *insert("models", "INSERT OR REPLACE", id="y" * 32))


@pytest.mark.parametrize("table", ["calibrations", "plans", "models", "qa_runs"])
def test_new_rows_are_taken(filled, table):
    filled.execute(*insert(table, **OTHER_KEYS[table]))
    assert len(contents(filled, table)) == 2


@pytest.mark.parametrize(
    "statement",
    [
        "INSERT OR REPLACE INTO audit SELECT sequence, at, 'you', action, outcome, session_id, detail, previous_hash, "
        "hash FROM audit WHERE sequence = 3",
        "INSERT INTO audit SELECT sequence, at, 'you', action, outcome, session_id, detail, previous_hash, hash "
        "FROM audit WHERE sequence = 3 ON CONFLICT (sequence) DO UPDATE SET actor = 'you'",
        "INSERT INTO audit SELECT 9, at, actor, action, outcome, session_id, detail, previous_hash, hash FROM audit "
        "WHERE sequence = 7",
        "INSERT INTO audit SELECT 0, at, actor, action, outcome, session_id, detail, previous_hash, hash FROM audit "
        "WHERE sequence = 7",
        "INSERT INTO audit SELECT NULL, at, actor, action, outcome, session_id, detail, previous_hash, hash FROM audit "
        "WHERE sequence = 7",
        "UPDATE OR REPLACE audit SET sequence = 3 WHERE sequence = 7",
    ],
)
def test_the_audit_takes_the_next_row_only(filled, statement):
    refused(filled, "audit", statement)


def test_every_table_is_either_kept_as_it_was_or_known_not_to_be(database):
    changing = {"sessions", "idempotency_keys", "alembic_version"}
    connection = sqlite3.connect(database.path)
    tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    sealed = {name for (name,) in connection.execute("SELECT tbl_name FROM sqlite_master WHERE type = 'trigger'")}
    connection.close()
    assert set(KEPT) | {"audit"} <= sealed
    assert not changing & sealed
    assert changing <= tables
