"""A data folder that does not exist, or has no database, is refused by name and is not created."""

import pytest
from typer.testing import CliRunner

from service.cli import app

pytestmark = pytest.mark.slow

SESSION = "5f0c1d7e-0000-4000-8000-000000000000"
READING = (
    ("users", "list"),
    ("users", "reset", "root"),
    ("users", "disable", "root"),
    ("users", "enable", "root"),
    ("keys", "list"),
    ("keys", "revoke", "k1"),
    ("audit", "verify"),
    ("audit", "export", "--out", "-"),
    ("database", "status"),
    ("database", "downgrade", "base"),
    ("qa", "list"),
    ("qa", "trend", "camera_distance_mm"),
    ("qa", "report", "r1", "--out", "report.pdf"),
    ("qa", "baseline"),
    ("samples", "verify", "--all"),
    ("backup", "backup.tar"),
    ("replay", SESSION),
)
WITHOUT_DATABASE = (("samples",), ("qa", "checks"), ("beam-line", "check"))


def name_of(words):
    return " ".join(words[:2])


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("words", [*READING, *WITHOUT_DATABASE], ids=name_of)
def test_a_mistyped_data_folder_is_named_and_not_created(words, tmp_path):
    typo = tmp_path / "dtaa"
    done = CliRunner().invoke(app, [*words, "--data", str(typo)])
    assert done.exit_code == 2, done.output
    assert f"there is no data folder {typo}: check --data" in done.stderr
    assert done.stderr.startswith(f"tidegate {words[0]}")
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("words", READING, ids=name_of)
def test_a_folder_without_a_database_is_refused_and_gets_none(words, tmp_path):
    folder = tmp_path / "data"
    folder.mkdir()
    done = CliRunner().invoke(app, [*words, "--data", str(folder)])
    assert done.exit_code == 2, done.output
    assert f"there is no database in the data folder {folder}" in done.stderr
    assert list(folder.iterdir()) == []


def test_a_missing_folder_of_the_environment_is_named_by_its_variable(tmp_path, monkeypatch):
    monkeypatch.setenv("TIDEGATE_DATA_DIR", str(tmp_path / "dtaa"))
    done = CliRunner().invoke(app, ["users", "list"])
    assert (done.exit_code, "check TIDEGATE_DATA_DIR" in done.stderr) == (2, True)


def test_a_backup_lowers_the_priority_of_its_process_below_a_running_service_s(tmp_path, monkeypatch):
    steps = []
    monkeypatch.setattr("os.nice", steps.append)
    CliRunner().invoke(app, ["backup", "backup.tar", "--data", str(tmp_path)])
    assert steps == [10]


def test_the_first_account_and_the_first_key_create_the_folder(tmp_path):
    for words in (("users", "add", "root", "--role", "admin"), ("keys", "create", "tps", "--scope", "sessions.read")):
        folder = tmp_path / words[0]
        assert CliRunner().invoke(app, [*words, "--data", str(folder)]).exit_code == 0
        assert folder.is_dir()
