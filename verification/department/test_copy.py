"""The copy at the hub: who reads it, how it is verified, and what happens where it was changed there."""

from contextlib import closing

import pytest
from sqlalchemy.exc import DBAPIError
from typer.testing import CliRunner

from service.cli import app
from service.storage.audit import Breakage
from service.storage.audit.check import check_chain
from service.storage.database.engine import Database
from tests.support.audit.rows import fill
from tests.support.audit.supervised_audit import SupervisedAudit
from tests.support.department.replication import answer, execute
from tests.support.waiting import eventually


def verified_at_hub(room):
    with closing(room.at_hub()) as database:
        return check_chain(database)


def refusals(room):
    query = f"SELECT apply_error_count FROM pg_stat_subscription_stats WHERE subname = '{room.hub_name}'"
    return answer(room.hub, room.hub_name, query)


def test_what_is_changed_at_the_hub_is_found(followed):
    fill(followed.database, 9)
    followed.follow()
    with pytest.raises(DBAPIError, match="append-only"):
        execute(followed.hub, followed.hub_name, "UPDATE audit SET actor = 'you' WHERE sequence = 4")
    execute(
        followed.hub,
        followed.hub_name,
        "ALTER TABLE audit DISABLE TRIGGER audit_no_update",
        "UPDATE audit SET actor = 'you' WHERE sequence = 4",
    )
    found = verified_at_hub(followed)
    assert (found.breakage, found.first_broken_sequence) == (Breakage.CHANGED, 4)


def test_rows_cut_off_at_the_hub_are_found_by_the_count_and_stop_the_next_row(followed):
    fill(followed.database, 9)
    followed.follow()
    execute(
        followed.hub,
        followed.hub_name,
        "ALTER TABLE audit DISABLE TRIGGER audit_no_delete",
        "DELETE FROM audit WHERE sequence > 7",
    )
    found = verified_at_hub(followed)
    assert (found.is_intact, found.rows) == (True, 7)
    assert "not compared with anchors" in found.notes[0]
    room, hub = followed.counts()
    assert room != hub
    fill(followed.database, 1)
    eventually(lambda: refusals(followed) > 0)
    assert "audit|7|" in followed.counts()[1]


@pytest.fixture
def auditor(followed, monkeypatch):
    """The command line of a person who may only read the hub's copy."""
    url = followed.hub.tcp_url(followed.hub_name).set(username="auditor", password="a reader's")
    monkeypatch.setenv("TIDEGATE_DATABASE_URL", url.set(drivername="postgresql").render_as_string(hide_password=False))
    yield lambda *words: CliRunner().invoke(app, ["audit", "verify", *words])
    execute(followed.hub, "postgres", "DROP ROLE IF EXISTS auditor")


def test_an_auditor_reads_the_copy_verifies_it_with_and_without_anchors_and_writes_nothing(
    followed, auditor, tmp_path, monkeypatch
):
    room = SupervisedAudit(followed.database, tmp_path)
    room.run()
    room.run()  # the second start has written down how far the anchors reached
    followed.follow()
    execute(
        followed.hub, "postgres", "CREATE ROLE auditor LOGIN PASSWORD 'a reader''s'", "GRANT tidegate_reader TO auditor"
    )
    followed.arrive()
    monkeypatch.setenv("TIDEGATE_AUDIT_ANCHOR_FILE", str(tmp_path / "not-the-room-s.jsonl"))
    assert auditor().stdout.startswith("BROKEN (anchors)")
    assert auditor("--without-anchors").stdout.startswith("intact: ")
    monkeypatch.setenv("TIDEGATE_AUDIT_ANCHOR_FILE", str(room.file.path))  # on a share that the hub reads
    assert auditor().stdout.startswith("intact: ")
    reader = followed.hub.tcp_url(followed.hub_name).set(username="auditor", password="a reader's")
    with closing(Database(reader)) as database, pytest.raises(DBAPIError, match="permission denied"):
        fill(database, 1)
    execute(
        followed.hub,
        followed.hub_name,
        "ALTER TABLE audit DISABLE TRIGGER audit_no_delete",
        "DELETE FROM audit WHERE sequence = (SELECT max(sequence) FROM audit)",
    )
    assert "(cut_off)" in auditor().stdout


def test_a_row_written_at_the_hub_stops_the_room_s_next_one(followed):
    fill(followed.database, 3)
    followed.follow()
    with closing(followed.at_hub()) as database:
        fill(database, 1)
    fill(followed.database, 2)
    eventually(lambda: refusals(followed) > 0)
    assert "audit|5|" in followed.counts()[0]
    assert "audit|4|" in followed.counts()[1]
