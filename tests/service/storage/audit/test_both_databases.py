"""What holds of the audit on SQLite holds on PostgreSQL: nothing changed, nothing removed, and every edit found."""

from contextlib import closing

import pytest
from sqlalchemy import text
from sqlalchemy.exc import DBAPIError

from service.storage import audit
from service.storage.audit import Breakage, Event
from service.storage.audit.anchors import AnchorFile
from service.storage.audit.check import check_whole
from service.storage.audit.export import ExportRequest, verify_export, write_export
from service.storage.audit.verification import read_links
from service.storage.database.engine import Database
from tests.support.audit.rows import COLUMN, KEPT, ROWS, fill
from tests.support.database.second_revision import FIRST

pytestmark = pytest.mark.both_databases


@pytest.fixture
def database(place):
    """The newest tables, on either database; not the chain that the other tests begin with."""
    with closing(Database(place)) as database:
        database.migrate()
        fill(database, 7)
        with database.write() as db:
            for table, row in ROWS.items():
                names = ", ".join(f'"{name}"' for name in row)
                marks = ", ".join(f":{name}" for name in row)
                booleans = {name: bool(value) if name.startswith("is_") else value for name, value in row.items()}
                db.execute(text(f"INSERT INTO {table} ({names}) VALUES ({marks})"), booleans)
        yield database


def refused(database, statement):
    with pytest.raises(DBAPIError, match=r"append-only|next row only|has ended"), database.write() as db:
        db.execute(text(statement))


@pytest.mark.parametrize("table", ["audit", *KEPT])
def test_no_statement_changes_or_removes_a_row(database, table):
    column = COLUMN.get(table, "actor")
    refused(database, f"UPDATE {table} SET {column} = 'you'")
    refused(database, f"DELETE FROM {table}")
    refused(database, f"INSERT INTO {table} SELECT * FROM {table} WHERE true ON CONFLICT DO NOTHING")
    if database.is_postgresql:
        refused(database, f"TRUNCATE {table} CASCADE")
        refused(database, f"SET LOCAL session_replication_role = replica; UPDATE {table} SET {column} = 'you'")
        refused(database, f"SET LOCAL session_replication_role = replica; TRUNCATE {table} CASCADE")


def test_no_insert_takes_the_place_of_a_row_or_leaves_a_gap(database):
    others = "at, actor, action, outcome, session_id, detail, previous_hash, hash FROM audit WHERE sequence = 3"
    for sequence in (3, 0, -1, 9, 100):
        refused(database, f"INSERT INTO audit SELECT {sequence}, {others}")
    refused(database, f"INSERT INTO audit SELECT 3, {others} ON CONFLICT (sequence) DO UPDATE SET actor = 'you'")


def test_every_edit_past_the_triggers_is_found(database, tmp_path):
    file = AnchorFile(tmp_path / "anchors.jsonl")
    with database.read() as db:
        head = read_links(db, None, 100)[-1]
    file.append("time", sequence=head.sequence, head_hash=head.hash)
    assert check_whole(database, file).rows == 7
    with database.write() as db:
        for trigger in ("audit_no_update", "audit_no_delete"):
            db.execute(text(f"DROP TRIGGER {trigger}{' ON audit' if database.is_postgresql else ''}"))
        db.execute(text("DELETE FROM audit WHERE sequence > 5"))
    found = check_whole(database, file)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.CUT_OFF, 6)
    with database.write() as db:
        db.execute(text("UPDATE audit SET actor = 'you' WHERE sequence = 2"))
    found = check_whole(database, file)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.CHANGED, 2)


def test_an_export_is_the_same_whole_thing(database):
    lines = "".join(write_export(database, ExportRequest())).splitlines()
    assert (verify_export(lines).is_intact, len(lines)) == (True, 8)


@pytest.mark.usefixtures("second")
def test_up_and_down_again_leaves_the_rows_and_the_triggers(database):
    database.migrate()
    database.downgrade(FIRST)
    database.migrate()
    refused(database, "UPDATE calibrations SET camera = 'e'")
    with database.write() as db:
        audit.append(db, Event(actor="me", action="test"))
    with database.read() as db:
        assert audit.verify(db).rows == 8
