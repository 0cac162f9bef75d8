"""People and keys from a shell, on a data folder that no service uses."""

import pytest
from typer.testing import CliRunner

from service.access.accounts.passwords import Argon2Hashing
from service.access.accounts.store import AccessStore
from service.cli import app
from service.core.settings.settings import Settings
from service.storage.audit.log import AuditLog
from service.storage.database.engine import Database
from service.storage.files.folder_lock import alone_in

pytestmark = pytest.mark.slow

PASSWORD = "a password from a pipe"


@pytest.fixture
def shell(tmp_path, monkeypatch):
    monkeypatch.setenv("TIDEGATE_DATA_DIR", str(tmp_path / "data"))

    def run(*words, says="", code=0):
        done = CliRunner().invoke(app, list(words), input=says)
        assert done.exit_code == code, done.output
        return done.output

    return run


@pytest.fixture
def kept(tmp_path):
    """What a service would find in the folder."""

    def look():
        database = Database(Settings(data_dir=tmp_path / "data").database_place)
        store = AccessStore(database)
        store.load()
        rows = AuditLog(database).page(None, 500, None).items
        database.close()
        return store, [row for row in reversed(rows) if row.action.startswith(("user.", "key."))]

    return look


def test_people_are_made_listed_and_disabled_and_each_is_audited(shell, kept):
    shell("users", "add", "root", "--role", "admin", "--password-stdin", says=f"{PASSWORD}\n")
    said = shell("users", "add", "B. Physicist", "--role", "physicist", "--role", "viewer")
    one_time = said.split()[-1]
    shell("users", "disable", "b. physicist")
    listed = shell("users", "list")
    assert "physicist,viewer  disabled" in listed
    store, rows = kept()
    hashing = Argon2Hashing()
    assert hashing.verify(store.users["root"].password_hash, PASSWORD)
    assert not store.users["root"].must_change_password
    assert hashing.verify(store.users["b. physicist"].password_hash, one_time)
    assert store.users["b. physicist"].must_change_password
    assert [(row.action, row.actor) for row in rows] == [
        ("user.create", "command line"),
        ("user.create", "command line"),
        ("user.change", "command line"),
    ]
    assert one_time not in str(rows)
    shell("users", "enable", "B. Physicist")
    assert shell("users", "reset", "B. Physicist").split()[-1] != one_time


def test_a_short_password_and_a_name_that_is_taken_are_stated_in_one_line(shell):
    said = shell("users", "add", "root", "--role", "admin", "--password-stdin", says="short\n", code=2)
    assert "12 to 256 characters" in said
    assert "short" not in said
    shell("users", "add", "root", "--role", "admin", "--password-stdin", says=f"{PASSWORD}\n")
    assert "this name is or was in use" in shell("users", "add", "ROOT", "--role", "admin", code=2)


def test_keys_are_made_shown_once_and_revoked(shell, kept):
    said = shell("keys", "create", "planning", "--scope", "sessions.read", "--days", "7")
    secret = said.split()[-1]
    key_id = said.split()[0]
    assert secret.startswith(f"tg_{key_id}_")
    listed = shell("keys", "list")
    assert "sessions.read" in listed
    assert secret not in listed
    shell("keys", "revoke", key_id)
    assert "revoked" in shell("keys", "list")
    _, rows = kept()
    assert [row.action for row in rows] == ["key.create", "key.revoke"]


def test_what_is_for_people_no_key_gets(shell):
    assert "scopes must be" in shell("keys", "create", "x", "--scope", "gate.acknowledge", code=2)


def test_a_folder_that_a_service_uses_is_left_alone(shell, tmp_path):
    shell("users", "add", "root", "--role", "admin")
    with alone_in(tmp_path / "data"):
        assert "in use" in shell("users", "list", code=2)
