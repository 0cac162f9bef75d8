"""The tables of QA: added to and read, never changed; 0005 goes up and down on a database that is in use."""

import sqlite3

import pytest

from service.storage.database.engine import Database

RUN = "INSERT {} INTO qa_runs VALUES ('q', 'daily', '{}', 'S', 'M', '{{}}', 0, 1, NULL, '{{}}', 1, '0', '2026-01-01')"
RESULT = "INSERT {} INTO qa_results VALUES ('q', '{}', 0, {}, 'mm', NULL, NULL, NULL, 1.0, 2.0, 'fail', '')"
OUTCOME = "INSERT {} INTO qa_outcomes VALUES ('q', 'finished', '', '{}', '{{}}', 'h', '2026-01-01')"
BASELINE = "INSERT {} INTO qa_baselines VALUES ({}, '{{}}', '{}', 'new camera', '2026-01-01')"
QA_TABLES = ("qa_runs", "qa_outcomes", "qa_results", "qa_baselines")


@pytest.fixture
def database(tmp_path):
    database = Database(tmp_path / "qa.db")
    database.migrate()
    yield database
    database.close()


@pytest.fixture
def raw(database):
    raw = sqlite3.connect(database.path, isolation_level=None)
    raw.execute(BASELINE.format("", 1, "me"))
    raw.execute(RUN.format("", "me"))
    raw.execute(RESULT.format("", "x", "NULL"))
    raw.execute(OUTCOME.format("", "fail"))
    yield raw
    raw.close()


TAMPERING = [
    "UPDATE qa_runs SET operator = 'somebody else'",
    "UPDATE qa_outcomes SET verdict = 'pass'",
    "UPDATE qa_results SET verdict = 'pass'",
    "UPDATE qa_baselines SET expected = '{\"x\": 1}'",
    *(f"DELETE FROM {table}" for table in QA_TABLES),
    *(
        statement.format(conflict, *values)
        for conflict in ("OR REPLACE", "OR IGNORE", "")
        for statement, values in (
            (RUN, ("somebody else",)),
            (RESULT, ("x", "0.0")),
            (OUTCOME, ("pass",)),
            (BASELINE, (1, "somebody else")),
        )
    ),
]


@pytest.mark.parametrize("statement", TAMPERING)
def test_what_was_written_can_be_neither_changed_nor_removed_nor_replaced(raw, statement):
    before = {table: raw.execute(f"SELECT * FROM {table}").fetchall() for table in QA_TABLES}
    with pytest.raises(sqlite3.IntegrityError):
        raw.execute(statement)
    assert {table: raw.execute(f"SELECT * FROM {table}").fetchall() for table in QA_TABLES} == before


def test_no_result_is_added_to_a_run_that_has_ended(raw):
    with pytest.raises(sqlite3.IntegrityError, match="has ended"):
        raw.execute(RESULT.format("", "another", "0.0"))


def test_baselines_come_in_order_without_gaps(raw):
    with pytest.raises(sqlite3.IntegrityError, match="next row only"):
        raw.execute(BASELINE.format("", 3, "me"))
    raw.execute(BASELINE.format("", 2, "me"))
