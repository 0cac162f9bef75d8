"""The data folder of a release is served, upgraded, backed up and restored by the next version, with every row.

Compatibility begins with 1.0.0. Until a release is kept, this version's own folder stands for one, and a made-up second
revision for the next version.
"""

import shutil

import pytest
from typer.testing import CliRunner

from service.cli import app
from service.core.settings.database_place import DATABASE_NAME
from service.core.settings.settings import Settings
from service.web.app import create_app
from tests.support.database.backups import rows_at
from tests.support.database.second_revision import second_revision
from tests.support.releases import data_of, released
from tests.support.replay.real_sessions import play
from tests.support.service.accounts import PeopleClient

PRESENT = "this version"


@pytest.fixture(scope="module")
def present(tmp_path_factory, regular_volunteer):
    """The folder of a session that this version ran."""
    data = tmp_path_factory.mktemp("present") / "data"
    data.mkdir(mode=0o700)
    play(data, regular_volunteer, seed=3)
    return data


@pytest.fixture(params=[*released(), PRESENT])
def data(request, tmp_path):
    """A release's folder, for a process that knows the next version's tables."""
    if request.param == PRESENT:
        found = shutil.copytree(request.getfixturevalue("present"), tmp_path / "data")
    else:
        found = data_of(request.param, tmp_path)
    with second_revision(tmp_path / "next version"):
        yield found


def run(*words):
    answer = CliRunner().invoke(app, [str(word) for word in words], env={"COLUMNS": "200"})
    assert answer.exit_code == 0, answer.output
    return answer.output


def assert_kept(before, after):
    for table, rows in before.items():
        kept = [{name: row[name] for name in old if name in row} for old, row in zip(rows, after[table], strict=False)]
        assert kept == rows, table


def test_a_released_folder_is_upgraded_and_keeps_every_row(data):
    before = rows_at(data / DATABASE_NAME)
    assert "made_up" not in before
    run("database", "upgrade", "--data", data)
    after = rows_at(data / DATABASE_NAME)
    assert_kept(before, after)
    assert after["made_up"] == []
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
            assert transitions["items"] != []
        assert client.get("/api/v1/audit/verify").json()["is_intact"]
