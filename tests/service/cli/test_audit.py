"""The shell's way to prove the log and to take it along."""

import shutil

import pytest
from typer.testing import CliRunner

from service.cli import app
from service.core.settings.settings import Settings
from service.storage.audit.anchors import AnchorFile
from service.storage.audit.verification import read_links
from service.storage.database.engine import Database
from tests.support.audit.rows import fill


def run(*arguments):
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def folder(tmp_path, filled_file):
    settings = Settings(data_dir=tmp_path / "data")
    settings.data_dir.mkdir()
    database = Database(shutil.copyfile(filled_file, settings.database_place))
    fill(database, 33)
    with database.read() as db:
        head = read_links(db, None, 100)[-1]
    AnchorFile(settings.anchor_file).append("time", sequence=head.sequence, head_hash=head.hash)
    yield settings.data_dir
    database.close()


def edit(folder, *statements):
    import sqlite3

    connection = sqlite3.connect(folder / "tidegate.db")
    for trigger in ("audit_no_update", "audit_no_delete"):
        connection.execute(f"DROP TRIGGER {trigger}")
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()


def test_an_intact_log_is_exit_code_0(folder):
    ran = run("audit", "verify", "--data", folder)
    assert (ran.exit_code, ran.stdout.startswith("intact: 40 rows, head ")) == (0, True)


@pytest.mark.parametrize(
    ("statement", "said"),
    [
        ("UPDATE audit SET actor = 'you' WHERE sequence = 3", "BROKEN at row 3 (changed)"),
        ("DELETE FROM audit WHERE sequence = 3", "BROKEN at row 4 (missing)"),
        ("DELETE FROM audit WHERE sequence > 30", "BROKEN at row 31 (cut_off)"),
    ],
)
def test_a_broken_log_is_exit_code_1_and_names_the_first_broken_row(folder, statement, said):
    edit(folder, statement)
    ran = run("audit", "verify", "--data", folder)
    assert ran.exit_code == 1
    assert ran.stdout.startswith(said)


def test_without_anchors_the_chain_alone_is_verified_and_that_is_stated(folder):
    edit(folder, "DELETE FROM audit WHERE sequence > 30")
    ran = run("audit", "verify", "--without-anchors", "--data", folder)
    assert (ran.exit_code, ran.stdout.startswith("intact: 30 rows, head ")) == (0, True)
    assert "rows cut off at the end are not found" in " ".join(ran.output.split())


def test_without_anchors_a_changed_row_is_found(folder):
    edit(folder, "UPDATE audit SET actor = 'you' WHERE sequence = 3")
    ran = run("audit", "verify", "--without-anchors", "--data", folder)
    assert (ran.exit_code, ran.stdout.startswith("BROKEN at row 3 (changed)")) == (1, True)


def test_an_export_has_no_anchors_to_be_left_out(folder, tmp_path):
    ran = run("audit", "verify", "--without-anchors", "--export", tmp_path / "rows.jsonl")
    assert ran.exit_code == 2
    assert "never compared with anchors" in " ".join(ran.output.split())


def test_where_there_is_no_log_none_is_made(tmp_path):
    ran = run("audit", "verify", "--data", tmp_path / "nowhere")
    assert ran.exit_code == 2
    assert not (tmp_path / "nowhere").exists()


@pytest.mark.parametrize("more", [(), ("--no-with-patients",)])
def test_an_export_is_written_audited_and_verified(folder, tmp_path, more):
    out = tmp_path / "audit.ndjson"
    ran = run("audit", "export", "--data", folder, *more, "--out", out)
    assert ran.exit_code == 0
    assert out.stat().st_mode & 0o777 == 0o600
    checked = run("audit", "verify", "--export", out)
    assert (checked.exit_code, checked.stdout.startswith("intact: 41 rows")) == (0, True)
    assert run("audit", "verify", "--data", folder).stdout.startswith("intact: 41 rows")


def test_an_export_that_was_edited_is_exit_code_1(folder, tmp_path):
    out = tmp_path / "audit.jsonl"
    run("audit", "export", "--data", folder, "--out", out)
    out.write_text(out.read_text().replace('"number":7', '"number":8', 1))
    ran = run("audit", "verify", "--export", out)
    assert ran.exit_code == 1
    assert ran.stdout.startswith("BROKEN at row 7 (changed)")


def test_an_export_goes_through_a_pipe(folder):
    ran = run("audit", "export", "--data", folder, "--out", "-")
    checked = CliRunner().invoke(app, ["audit", "verify", "--export", "-"], input=ran.stdout)
    assert checked.stdout.startswith("intact: 41 rows")


def test_a_file_that_is_there_is_not_written_over(folder, tmp_path):
    out = tmp_path / "audit.jsonl"
    out.write_text("mine")
    assert run("audit", "export", "--data", folder, "--out", out).exit_code == 2
    assert out.read_text() == "mine"


def test_a_time_that_is_none_is_refused(folder, tmp_path):
    ran = run("audit", "export", "--data", folder, "--out", tmp_path / "x", "--from", "yesterday")
    assert ran.exit_code == 2
    assert "--from must be a time" in ran.stderr
