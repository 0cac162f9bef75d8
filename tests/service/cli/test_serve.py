"""What `tidegate serve` does to its own process."""

import contextlib
import gc
import json
import os
import signal
import subprocess
import sys

import anyio
import pytest
from sqlalchemy import text
from typer.testing import CliRunner

from engine import __version__
from service.cli import app as command_line
from service.cli.serve import _exclude_from_garbage_collection
from service.core.settings.database_place import DATABASE_NAME
from service.core.settings.settings import Settings
from service.storage.database.engine import Database
from service.storage.database.migrations import MigrationError
from service.web.app import create_app
from tests.support.service.processes import free_port

pytestmark = pytest.mark.slow


def test_what_was_there_at_the_start_is_collected_no_more():
    before, kept = gc.get_freeze_count(), [[] for _ in range(1000)]
    assert any(item is kept for item in gc.get_objects())
    _exclude_from_garbage_collection()
    assert gc.get_freeze_count() > before + len(kept)
    assert not any(item is kept for item in gc.get_objects())


def test_a_database_of_a_newer_version_is_refused_in_one_line(tmp_path):
    (tmp_path / "data").mkdir(mode=0o700)
    database = Database(tmp_path / "data" / DATABASE_NAME)
    database.migrate()
    with database.write() as db:
        db.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    database.close()
    app = create_app(Settings(data_dir=tmp_path / "data"))
    said = list(anyio.run(_started, app))
    assert [message["type"] for message in said] == ["lifespan.startup.failed"]
    assert said[0]["message"].startswith("the service did not start: the database is at revision 9999")
    assert "\n" not in said[0]["message"]


async def _started(app):
    said = []

    async def receive():
        return {"type": "lifespan.startup"}

    async def send(message):
        said.append(message)

    with contextlib.suppress(MigrationError):  # the server reads the message
        await app({"type": "lifespan", "asgi": {"version": "3.0"}, "state": {}}, receive, send)
    return said


@pytest.fixture
def data(tmp_path):
    """Make a data folder with an account, so that the start prints no password."""
    folder = tmp_path / "data"
    done = CliRunner().invoke(command_line, ["users", "add", "root", "--role", "admin", "--data", str(folder)])
    assert done.exit_code == 0, done.output
    return folder


def lines_until_listening(data, log_format):
    """Run ``tidegate serve`` until it listens; return its lines on standard error."""
    port = free_port()
    with subprocess.Popen(
        [sys.executable, "-m", "service.cli", "serve", "--port", str(port), "--data", str(data)],
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "TIDEGATE_LOG_FORMAT": log_format},
    ) as process:
        lines = []
        for line in process.stderr:
            lines.append(line.rstrip("\n"))
            if f"listening on http://127.0.0.1:{port}/" in line:
                break
        process.send_signal(signal.SIGTERM)
        process.stderr.read()
    assert process.returncode == 0
    return lines


def test_the_steps_of_the_start_are_printed_from_the_first_moment_on(data):
    lines = lines_until_listening(data, "text")
    assert lines[0] == f"Tidegate {__version__} starting"
    assert f"data folder {data}" in lines[1]
    assert "opening the database" in lines[-2]
    assert "SIMULATED beam line" in lines[-1]


def test_in_a_json_log_every_line_of_the_start_is_json(data):
    said = [json.loads(line) for line in lines_until_listening(data, "json")]
    assert {one["logger"] for one in said} == {"tidegate.start"}
    assert f"data folder {data}" in said[0]["message"]
    assert said[-1]["message"].startswith("listening on ")


def test_the_first_line_waits_for_no_import():
    program = "import sys, service.cli.serve; print([n for n in ('numpy', 'pydantic', 'rich') if n in sys.modules])"
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "[]"


def refused(*words):
    done = CliRunner().invoke(command_line, ["serve", *map(str, words)])
    assert done.exit_code == 2, done.output
    return done.stderr.splitlines()[-1]


def test_a_recordings_folder_that_does_not_exist_is_refused_by_option_and_value(tmp_path):
    said = refused("--data", tmp_path / "data", "--recordings", tmp_path, "--recordings", tmp_path / "absent")
    assert said == f"tidegate serve: --recordings {tmp_path / 'absent'}: there is no such folder"
    assert not (tmp_path / "data").exists()


def test_two_recordings_of_one_path_in_two_folders_are_refused_with_both(tmp_path):
    files = [tmp_path / name / "day" / "chest.oni" for name in ("a", "b")]
    for file in files:
        file.parent.mkdir(parents=True)
        file.touch()
    folders = [word for file in files for word in ("--recordings", file.parent.parent)]
    said = refused("--data", tmp_path / "data", *folders)
    assert all(str(file) in said for file in files)
    assert not (tmp_path / "data").exists()
