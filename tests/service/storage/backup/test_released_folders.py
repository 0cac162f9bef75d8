"""The data folder of each release is served, upgraded, backed up and restored by this version, with every row."""

import pytest
from typer.testing import CliRunner

from service.cli import app
from service.core.settings.database_place import DATABASE_NAME
from service.core.settings.settings import Settings
from service.web.app import create_app
from tests.support.database.backups import rows_at
from tests.support.earlier_files import data_of, released
from tests.support.service.accounts import PeopleClient

RELEASED = released()


@pytest.fixture(params=RELEASED)
def data(request, tmp_path):
    return data_of(request.param, tmp_path)


def run(*words):
    answer = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})
    assert answer.exit_code == 0, answer.output
    return answer.output


def assert_kept(before, after):
    for table, rows in before.items():
        kept = [{name: row[name] for name in old if name in row} for old, row in zip(rows, after[table], strict=False)]
        assert kept == rows, table


def test_a_release_is_kept():
    assert RELEASED != []


def test_a_released_folder_is_upgraded_and_keeps_every_row(data):
    before = rows_at(data / DATABASE_NAME)
    run("database", "upgrade", "--data", data)
    assert_kept(before, rows_at(data / DATABASE_NAME))
    assert "intact" in run("audit", "verify", "--data", data)


def test_a_released_folder_is_backed_up_and_restored_elsewhere(data, tmp_path):
    before = rows_at(data / DATABASE_NAME)
    run("backup", tmp_path / "all.backup", "--data", data)
    run("restore", tmp_path / "all.backup", "--data", tmp_path / "elsewhere")
    before["logins"] = []  # a log-in is not carried to another machine
    assert_kept(before, rows_at(tmp_path / "elsewhere" / DATABASE_NAME))
    assert "intact" in run("audit", "verify", "--data", tmp_path / "elsewhere")


def test_a_service_serves_a_released_folder(data, tmp_path):
    settings = Settings(data_dir=data, journal_dir=tmp_path / "journals", allowed_hosts=("testserver",))
    with PeopleClient(create_app(settings)) as client:
        sessions = client.get("/api/v1/sessions").json()["items"]
        assert sessions != []
        for session in sessions:
            samples = client.get(f"/api/v1/sessions/{session['id']}/samples", params={"format": "csv"})
            assert len(samples.text.splitlines()) > 100, samples.text[:500]
            transitions = client.get(f"/api/v1/sessions/{session['id']}/transitions", params={"limit": 500}).json()
            assert "beam_on" in {one["to_state"] for one in transitions["items"]}
        assert client.get("/api/v1/audit/verify").json()["is_intact"]
