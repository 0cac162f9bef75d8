"""The engine's process starts before the service's own imports, and ends with a start that fails or is killed."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.access.tls_certificate import make_certificate
from tests.support.repository import ROOT
from tests.support.service.processes import free_port
from tests.support.waiting import eventually

MODULE = b"service.engine_host.process"
SESSION = 3
"""Field of /proc/PID/stat behind the command's name: every process of one service is in its session."""


def engines_of(service):
    """Return the ids of the running engine processes that a service has started."""
    return [pid for pid in _all_processes() if _is_engine_in(pid, service.pid)]


def _all_processes():
    return [int(one.name) for one in Path("/proc").iterdir() if one.name.isdecimal()]


def _is_engine_in(pid, session):
    with contextlib.suppress(OSError):
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        if int(fields[SESSION]) != session or fields[0] == "Z":
            return False
        return MODULE in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    return False


@pytest.fixture
def start(tmp_path, interruptible):
    """Start the command in a session of its own, by a program where one is given; end everything of it afterwards."""
    started = []

    def start(*program, **environment):
        words = program or ("-m", "service.cli", "serve", "--port", str(free_port()), "--data", str(tmp_path / "data"))
        log = (tmp_path / "log").open("wb")
        process = subprocess.Popen(
            [sys.executable, *words],
            cwd=ROOT,
            env={**os.environ, "TIDEGATE_JOURNAL_DIR": str(tmp_path / "journals"), **environment},
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
        log.close()
        started.append(process)
        return process

    yield start
    for process in started:
        for pid in engines_of(process):
            os.kill(pid, signal.SIGKILL)
        if process.poll() is None:
            process.kill()
        process.wait()


BEFORE_IMPORTS = """
import sys
from service.engine_host.process import process_engine

class Asked:
    def __init__(self, settings):
        found = sorted({"fastapi", "sqlalchemy", "alembic", "uvicorn"} & set(sys.modules))
        sys.stderr.write(f"loaded {found}\\n")  # in one piece: a thread writes the log there, too
        sys.stderr.flush()
        raise SystemExit(7)

process_engine.ProcessEngine = Asked
from service.cli import app
app(["serve", "--port", sys.argv[1], "--data", sys.argv[2]])
"""


def test_the_engine_is_started_before_the_web_server_is_imported(start, tmp_path):
    process = start("-c", BEFORE_IMPORTS, str(free_port()), str(tmp_path / "data"))
    assert process.wait(120.0) == 7, (tmp_path / "log").read_text()
    assert "loaded []" in (tmp_path / "log").read_text()


REFUSED = """
import sys, threading
from engine.core.errors import InvalidValueError
from service.engine_host.process import process_engine
from service.web import app as web

def refuse(*_arguments, **_options):
    WAIT
    raise InvalidValueError("tidegate", 1, "another")

class Seen(process_engine.ProcessEngine):
    def close(self):
        super().close()
        print("closed", file=sys.stderr, flush=True)

process_engine.ProcessEngine = Seen
web.create_app = refuse
from service.cli import app
app(["serve", "--port", sys.argv[1], "--data", sys.argv[2]])
"""


WAITS = {
    "at once": "pass",
    "ready": """while _arguments[1](None).trouble is not None:
        threading.Event().wait(0.01)""",
}


@pytest.mark.parametrize("moment", WAITS)
def test_a_start_that_fails_ends_the_engine(start, tmp_path, moment):
    """Whether the engine's process is still importing, or on standby."""
    program = REFUSED.replace("WAIT", WAITS[moment])
    process = start("-c", program, str(free_port()), str(tmp_path / "data"))
    assert process.wait(120.0) == 2, (tmp_path / "log").read_text()
    assert engines_of(process) == []
    said = (tmp_path / "log").read_text()
    assert said.index("closed") < said.index("tidegate serve: "), said


def test_a_certificate_that_is_refused_leaves_no_engine(start, tmp_path):
    (tmp_path / "tls").mkdir()
    cert, key = make_certificate(tmp_path / "tls")
    key.write_text(key.read_text()[:100])
    process = start(TIDEGATE_TLS_CERT=str(cert), TIDEGATE_TLS_KEY=str(key))
    assert process.wait(120.0) == 2
    assert "cannot be used for TLS" in (tmp_path / "log").read_text()
    assert engines_of(process) == []


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT], ids=lambda one: one.name)
def test_a_start_that_is_ended_by_a_signal_takes_its_engine_along(start, number):
    process = start()
    eventually(lambda: engines_of(process), within_s=120.0)
    process.send_signal(number)
    process.wait(120.0)
    eventually(lambda: not engines_of(process))


def test_a_service_that_serves_has_one_engine_and_both_end_at_the_stop(start, tmp_path):
    process = start()
    eventually(lambda: "listening on" in (tmp_path / "log").read_text(), within_s=120.0)
    eventually(lambda: len(engines_of(process)) == 1)
    process.send_signal(signal.SIGTERM)
    assert process.wait(60.0) == 0
    assert engines_of(process) == []
