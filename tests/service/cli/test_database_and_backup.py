"""`tidegate database`, `backup` and `restore` from the shell."""

import json
import stat
from contextlib import closing

import pytest
from sqlalchemy import text
from typer.testing import CliRunner

from service.cli import app
from service.storage.database.engine import Database
from service.storage.files.folder_lock import alone_in
from tests.support.database.backups import FILES, fill_folder, rows_at, write_rows
from tests.support.database.rows import add_rows, tables
from tests.support.database.second_revision import FIRST, SECOND

pytestmark = [pytest.mark.both_databases, pytest.mark.slow]


@pytest.fixture
def run(monkeypatch, database_url):
    if database_url is not None:
        monkeypatch.setenv("TIDEGATE_DATABASE_URL", database_url)

    def run(*words):
        return CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})

    return run


@pytest.fixture
def data(tmp_path, place):
    (tmp_path / "data").mkdir()
    if database_is_file(place):
        return tmp_path
    return tmp_path / "data"


def database_is_file(place):
    return not hasattr(place, "drivername")


@pytest.mark.usefixtures("second")
def test_the_tables_go_up_and_where_they_stand_is_printed(run, tmp_path, empty_place, monkeypatch):
    if not database_is_file(empty_place):
        monkeypatch.setenv("TIDEGATE_DATABASE_URL", empty_place.render_as_string(hide_password=False))
    with closing(Database(empty_place)) as database:
        database.migrate(FIRST)
    reported = run("database", "status", "--data", tmp_path)
    assert f"revision {FIRST}" in reported.output
    assert f"pending: {SECOND} Made up" in reported.output
    assert run("database", "upgrade", "--data", tmp_path).exit_code == 0
    assert "pending" not in run("database", "status", "--data", tmp_path).output
    copies = list(tmp_path.glob(f"tidegate-before-upgrade-from-{FIRST}.db"))
    assert len(copies) == database_is_file(empty_place)
    assert all(stat.S_IMODE(copy.stat().st_mode) == 0o600 for copy in copies)
    assert not copies or "made_up" not in rows_at(copies[0])


@pytest.mark.usefixtures("second")
def test_a_way_down_that_would_lose_something_is_refused_unless_it_is_forced(run, data, database, place):
    database.migrate()
    with database.write() as db:
        add_rows(db.connection())
    refused = run("database", "downgrade", FIRST, "--data", data)
    assert refused.exit_code == 2
    assert "the older schema cannot store this" in refused.output
    assert "made_up: 1 rows" in refused.output
    assert "made_up" in rows_at(place)
    assert run("database", "downgrade", FIRST, "--data", data, "--force").exit_code == 0
    assert "made_up" not in rows_at(place)
    for wrong in (FIRST, SECOND, "none"):
        assert f"not a revision older than {FIRST}" in run("database", "downgrade", wrong, "--data", data).output


def test_a_backup_goes_beside_a_service_and_a_restore_does_not(run, data, database, place, tmp_path):
    write_rows(database)
    fill_folder(data)
    out = tmp_path / "all.backup"
    with alone_in(data):
        made = run("backup", out, "--data", data)
        assert made.exit_code == 0, made.output
        assert "restored and compared" in made.output
        assert run("restore", out, "--check").exit_code == 0
        assert "in use" in run("restore", out, "--data", data).output
    reported = rows_at(place)["audit"][-1]
    assert reported["action"] == "backup.made"
    assert json.loads(reported["detail"])["sha256"] in made.output
    assert json.loads(reported["detail"])["is_verified"] is True
    assert "exists already" in run("backup", out, "--data", data).output


def test_what_was_backed_up_is_restored_into_an_empty_folder_and_a_filled_one_is_left_alone(
    run, data, database, tmp_path, monkeypatch
):
    write_rows(database)
    fill_folder(data)
    out = tmp_path / "all.backup"
    assert run("backup", out, "--data", data, "--no-verify").exit_code == 0
    refused = run("restore", out, "--data", data)
    assert (refused.exit_code, "not empty" in refused.output) == (2, True)
    monkeypatch.delenv("TIDEGATE_DATABASE_URL", raising=False)
    done = run("restore", out, "--data", tmp_path / "new")
    assert done.exit_code == 0, done.output
    assert "1 accounts and 0 API keys are valid again" in done.output
    assert rows_at(tmp_path / "new" / "tidegate.db")["audit"][-1]["action"] == "backup.restored"
    assert (tmp_path / "new/models/ab12.npz").read_bytes() == FILES["models/ab12.npz"]


def test_a_restore_counts_exactly_the_accounts_that_are_active_again(run, data, database, tmp_path, monkeypatch):
    others = ("users", "api_keys", "calibrations")
    with database.write() as db:
        connection = db.connection()
        but = tuple(table.name for table in tables(connection) if table.name not in others)
        for _ in range(3):  # the second person is disabled, and all keys are revoked
            add_rows(connection, but=but)
        in_time, over = "2999-01-01T00:00:00.000000Z", "2001-01-01T00:00:00.000000Z"
        db.execute(text("UPDATE api_keys SET expires_at = :at"), {"at": in_time})
        db.execute(text("UPDATE api_keys SET revoked_at = NULL WHERE id NOT LIKE '1%'"))
        db.execute(text("UPDATE api_keys SET expires_at = :at WHERE id LIKE '2%'"), {"at": over})
    out = tmp_path / "all.backup"
    assert run("backup", out, "--data", data, "--no-verify").exit_code == 0
    monkeypatch.delenv("TIDEGATE_DATABASE_URL", raising=False)
    done = run("restore", out, "--data", tmp_path / "new")
    assert "2 accounts and 1 API keys are valid again" in done.output
    assert "at the time of the backup" in done.output


def test_a_backup_that_would_leave_too_little_of_the_disk_is_not_begun(run, data, database, tmp_path, monkeypatch):
    monkeypatch.setenv("TIDEGATE_MIN_FREE_DISK_MB", "1000000")
    refused = run("backup", tmp_path / "all.backup", "--data", data)
    assert (refused.exit_code, "have to stay free" in refused.output) == (2, True)
    assert not list(tmp_path.glob("all.backup*"))


def test_without_a_database_nothing_is_backed_up_and_none_is_made(run, tmp_path, database_kind):
    if database_kind == "sqlite":
        assert "there is no data folder" in run("backup", tmp_path / "x", "--data", tmp_path / "nowhere").output
        assert not (tmp_path / "nowhere").exists()
