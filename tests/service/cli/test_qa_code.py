"""``tidegate qa code``: made at the machine beside a running service, for a physicist, audited; and what it opens."""

from datetime import UTC, datetime

import pytest
from typer.testing import CliRunner

from service.access.accounts.records import User
from service.access.accounts.store import AccessStore
from service.cli import app
from service.core.permissions import Role
from service.core.settings.settings import Settings
from service.qa.one_time_code import FILE_NAME, OneTimeCodes
from service.storage.audit.log import AuditLog
from service.storage.database.engine import Database
from service.storage.files.folder_lock import alone_in

pytestmark = pytest.mark.usefixtures("no_settings_around")

PEOPLE = {
    "A. Physicist": {Role.PHYSICIST},
    "B. Therapist": {Role.THERAPIST, Role.ADMIN},
    "C. Gone": {Role.PHYSICIST},
}


@pytest.fixture
def data(tmp_path):
    folder = tmp_path / "data"
    folder.mkdir(mode=0o700)
    database = Database(Settings(data_dir=folder).database_place)
    database.migrate()
    store = AccessStore(database)
    at = datetime.now(UTC)
    for name, roles in PEOPLE.items():
        is_disabled = name == "C. Gone"
        user = User(name=name, password_hash=None, roles=frozenset(roles), is_disabled=is_disabled, created_at=at)
        store.write(save=[user])
    database.close()
    return folder


def ask(data, *arguments):
    return CliRunner().invoke(app, ["qa", "code", *arguments, "--data", str(data)])


def audited(data):
    database = Database(Settings(data_dir=data).database_place)
    try:
        return AuditLog(database).page(None, 50, None).items
    finally:
        database.close()


def test_it_displays_a_code_that_opens_beside_a_running_service_and_is_audited(data):
    with alone_in(data):  # as a running service has the folder
        shown = ask(data, "--operator", "a. physicist")
    assert shown.exit_code == 0, shown.output
    code = shown.stdout.split()[0]
    assert "A. Physicist" in shown.stdout
    OneTimeCodes(data).redeem(code, "A. Physicist")
    (row,) = audited(data)
    assert (row.action, row.actor, row.outcome) == ("qa.code", "command line", "done")
    assert row.detail == {"operator": "A. Physicist", "valid_s": 300.0}
    assert code not in str(row)


@pytest.mark.parametrize("name", ["B. Therapist", "C. Gone", "Nobody here"])
def test_only_a_physicist_gets_one(data, name):
    refused = ask(data, "--operator", name)
    assert refused.exit_code == 2
    assert "operator" in refused.stderr or "no account" in refused.stderr
    assert not (data / FILE_NAME).exists()
    assert audited(data) == []


def test_none_is_made_where_it_cannot_be_audited(data, monkeypatch):
    def fail(*_arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(AuditLog, "write", fail)
    assert ask(data, "--operator", "A. Physicist").exit_code == 2
    assert not (data / FILE_NAME).exists()


def test_a_mistyped_folder_is_refused(tmp_path):
    assert ask(tmp_path / "absent", "--operator", "A. Physicist").exit_code == 2
    assert not (tmp_path / "absent").exists()
