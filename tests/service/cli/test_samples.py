"""`tidegate samples`: sizes, and verification against the audit."""

import pytest
from typer.testing import CliRunner

from service.cli import app
from service.sessions.recovery.interrupted import close_interrupted
from tests.support.samples.records import SESSION, write_stream
from tests.support.samples.sessions import add_session


@pytest.fixture
def run(database, sample_store, monkeypatch):
    """A data folder with one session that was interrupted and closed."""
    add_session(database)
    write_stream(sample_store.folder, is_finished=False)
    close_interrupted(database, sample_store)
    monkeypatch.setenv("TIDEGATE_DATABASE_URL", "")
    monkeypatch.delenv("TIDEGATE_DATABASE_URL")
    database.path.replace(sample_store.folder.parent / "tidegate.db")
    for suffix in ("-wal", "-shm"):
        other = database.path.with_name(database.path.name + suffix)
        if other.exists():
            other.replace(sample_store.folder.parent / f"tidegate.db{suffix}")
    return lambda *words: CliRunner().invoke(app, ["samples", *words, "--data", str(sample_store.folder.parent)])


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
        assert "as recorded in the audit" in done.stdout
        assert "1 sessions, 0 not intact" in done.stdout


@pytest.mark.parametrize("harm", ["changed", "replaced by another's", "taken away"])
def test_a_file_that_is_not_what_the_audit_knows_is_named(run, sample_store, harm):
    path = sample_store.parquet_path(SESSION)
    content = bytearray(path.read_bytes())
    if harm == "changed":
        content[200] ^= 1
        path.write_bytes(content)
    elif harm == "taken away":
        path.unlink()
    else:
        write_stream(sample_store.folder, 39)
        sample_store.settle(SESSION)
        sample_store.forget_stream(SESSION)
    done = run("verify", SESSION)
    assert done.exit_code == 1
    assert "1 not intact" in done.stdout


def test_a_file_of_no_session_is_named(run, sample_store):
    sample_store.parquet_path(SESSION).with_name("f" * 32 + ".parquet").write_bytes(b"stray")
    done = run("verify", "--all")
    assert (done.exit_code, "there is no such session" in done.stdout) == (1, True)


@pytest.mark.parametrize("words", [("verify",), ("verify", SESSION, "--all"), ("verify", "0" * 32)])
def test_what_cannot_be_done_is_stated_in_a_line(run, words):
    done = run(*words)
    assert done.exit_code == 2
    assert done.stdout == ""
    assert len(done.stderr.strip().splitlines()) == 1
