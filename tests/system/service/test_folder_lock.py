"""One program at a time has a data folder, and so its beam line."""

import signal
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from service.cli import app
from service.storage.files.folder_lock import LOCK_NAME, FolderInUseError, alone_in
from tests.support.beam.receivers import receiver
from tests.support.service.processes import free_port, service_process
from tests.support.waiting import eventually

pytestmark = [pytest.mark.waiting, pytest.mark.usefixtures("no_settings_around")]

PULSE = ("--pulse", "60", "--yes-the-beam-is-safe", "--repeats", "1")
HOLDER = """
import sys
from pathlib import Path
from service.storage.files.folder_lock import alone_in
with alone_in(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that has the folder."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.kill()


def check(*arguments):
    return CliRunner().invoke(app, ["beam-line", "check", *arguments])


def test_a_folder_is_made_held_by_one_and_free_again(tmp_path):
    folder = tmp_path / "a" / "b"
    with alone_in(folder), pytest.raises(FolderInUseError, match="is in use"), alone_in(folder):
        pytest.fail("two have it")
    with alone_in(folder):
        assert (folder / LOCK_NAME).exists()


def test_a_failed_attempt_does_not_let_go_of_what_another_has(tmp_path):
    with alone_in(tmp_path):
        for _ in range(2):
            with pytest.raises(FolderInUseError), alone_in(tmp_path):
                pytest.fail("two have it")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM], ids=str)
def test_a_process_that_ends_anyhow_lets_go(holder, tmp_path, number):
    with pytest.raises(FolderInUseError), alone_in(tmp_path):
        pytest.fail("two have it")
    holder.send_signal(number)
    holder.wait()
    with alone_in(tmp_path):
        pass


def test_a_folder_that_cannot_be_locked_is_not_used(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(FolderInUseError, match="cannot be locked"), alone_in(tmp_path / "file"):
        pytest.fail("a file is no folder")


@pytest.mark.parametrize("arguments", [PULSE, ()], ids=["pulse", "check"])
def test_no_line_is_commanded_beside_a_service(monkeypatch, tmp_path, holder, arguments):
    with receiver("tcp") as far:
        monkeypatch.setenv("TIDEGATE_BEAM_LINE", "modbus-tcp")
        monkeypatch.setenv("TIDEGATE_BEAM_MODBUS_HOST", "127.0.0.1")
        monkeypatch.setenv("TIDEGATE_BEAM_MODBUS_PORT", far.where)
        refused = check(*arguments, "--data", str(tmp_path))
        assert refused.exit_code == 2
        assert refused.stdout == ""
        assert refused.stderr.count("\n") == 1
        assert f"{tmp_path} is in use" in refused.stderr
    assert far.seen == []


def test_a_check_takes_the_folder_of_the_settings_and_gives_it_back(monkeypatch, tmp_path):
    monkeypatch.setattr("service.cli.beam_line.WATCHED_S", 0.0)
    monkeypatch.setenv("TIDEGATE_DATA_DIR", str(tmp_path))
    with alone_in(tmp_path):
        assert check(*PULSE).exit_code == 2
    assert check(*PULSE).exit_code == 0
    with alone_in(tmp_path):
        pass


def test_a_check_before_the_first_start_makes_no_folder(monkeypatch, tmp_path):
    monkeypatch.setattr("service.cli.beam_line.WATCHED_S", 0.0)
    monkeypatch.setenv("TIDEGATE_DATA_DIR", str(tmp_path / "none"))
    assert check().exit_code == 0
    assert list(tmp_path.iterdir()) == []


def test_a_running_service_has_its_folder_until_it_is_killed(tmp_path):
    data = tmp_path / "data"
    arguments = ("service.cli", "serve", "--port", "{}", "--data", str(data))
    port = free_port()
    with service_process(*(one.format(port) for one in arguments), port=port, log=tmp_path / "log") as (process, _):
        assert f"{data} is in use" in check(*PULSE, "--data", str(data)).stderr
        second = subprocess.run(
            [sys.executable, "-m", *(one.format(free_port()) for one in arguments)],
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert (second.returncode, len(second.stderr.strip().splitlines())) == (2, 2)  # "starting", and why not
        assert f"{data} is in use" in second.stderr
        process.kill()
        process.wait()
        eventually(lambda: _is_free(data))


def _is_free(folder):
    try:
        with alone_in(folder):
            return True
    except FolderInUseError:
        return False


def test_a_service_whose_recordings_may_gate_a_real_line_states_it_in_its_first_lines(tmp_path, monkeypatch):
    monkeypatch.setenv("TIDEGATE_BEAM_LINE", "modbus-tcp")
    monkeypatch.setenv("TIDEGATE_BEAM_MODBUS_HOST", "127.0.0.1")
    monkeypatch.setenv("TIDEGATE_RECORDINGS_MAY_GATE", "true")
    port, log = free_port(), tmp_path / "log"
    arguments = ("service.cli", "serve", "--port", str(port), "--data", str(tmp_path / "data"))
    with service_process(*arguments, port=port, log=log):
        pass
    assert "a played recording may turn on a REAL beam line (modbus-tcp)" in log.read_text()
