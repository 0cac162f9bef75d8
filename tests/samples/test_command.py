"""`tidegate samples`: sizes, and whether samples are what the audit says."""

import pytest
from typer.testing import CliRunner

from service.cli import app
from service.interrupted import close_interrupted
from tests.samples.conftest import add_session
from tests.samples.records import SESSION, write_stream


@pytest.fixture
def run(database, shelf, monkeypatch):
    """A data folder with one session that was interrupted and closed."""
    add_session(database)
    write_stream(shelf.folder, is_finished=False)
    close_interrupted(database, shelf)
    monkeypatch.setenv("TIDEGATE_DATABASE_URL", "")
    monkeypatch.delenv("TIDEGATE_DATABASE_URL")
    database.path.replace(shelf.folder.parent / "tidegate.db")
    for suffix in ("-wal", "-shm"):
        other = database.path.with_name(database.path.name + suffix)
        if other.exists():
            other.replace(shelf.folder.parent / f"tidegate.db{suffix}")
    return lambda *words: CliRunner().invoke(app, ["samples", *words, "--data", str(shelf.folder.parent)])


def test_sizes_are_listed(run):
    done = run()
    assert done.exit_code == 0
    assert SESSION in done.stdout
    assert "1 files" in done.stdout
    assert "quota none" in done.stdout


def test_what_the_audit_knows_is_good(run):
    for words in (("verify", SESSION), ("verify", "--all")):
        done = run(*words)
        assert done.exit_code == 0
        assert "as the audit knows it" in done.stdout
        assert "1 sessions, 0 not as they should be" in done.stdout


@pytest.mark.parametrize("harm", ["changed", "replaced by another's", "taken away"])
def test_a_file_that_is_not_what_the_audit_knows_is_named(run, shelf, harm):
    path = shelf.parquet_path(SESSION)
    content = bytearray(path.read_bytes())
    if harm == "changed":
        content[200] ^= 1
        path.write_bytes(content)
    elif harm == "taken away":
        path.unlink()
    else:
        write_stream(shelf.folder, 39)
        shelf.settle(SESSION)
        shelf.forget_stream(SESSION)
    done = run("verify", SESSION)
    assert done.exit_code == 1
    assert "1 not as they should be" in done.stdout


def test_a_file_of_no_session_is_named(run, shelf):
    shelf.parquet_path(SESSION).with_name("f" * 32 + ".parquet").write_bytes(b"stray")
    done = run("verify", "--all")
    assert (done.exit_code, "there is no such session" in done.stdout) == (1, True)


@pytest.mark.parametrize("words", [("verify",), ("verify", SESSION, "--all"), ("verify", "0" * 32)])
def test_what_cannot_be_done_is_said_in_a_line(run, words):
    done = run(*words)
    assert done.exit_code == 2
    assert done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1


def test_an_empty_folder_has_no_database(tmp_path):
    done = CliRunner().invoke(app, ["samples", "verify", "--all", "--data", str(tmp_path / "none")])
    assert done.exit_code == 2
    assert "there is no database" in done.stderr
