"""`make demo` is ended by SIGTERM, as by a service manager: its service ends with it."""

import signal
import subprocess
import sys
import urllib.request

import pytest

from service.storage.files.folder_lock import alone_in
from tests.support.repository import ROOT
from tests.support.service.processes import free_port
from tests.support.waiting import PATIENCE_S, eventually

pytestmark = [pytest.mark.slow, pytest.mark.verification, pytest.mark.waiting]


def answers(port):
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=1.0) as answer:
            return answer.status == 200
    except OSError:
        return False


@pytest.mark.parametrize("is_serving", [False, True], ids=["while the service starts", "while it serves"])
def test_its_service_is_ended_too(tmp_path, is_serving):
    port = free_port()
    command = [sys.executable, "-m", "service.cli", "demo", "--folder", str(tmp_path), "--port", str(port), "--keep"]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT) as demo:
        try:
            eventually(lambda: answers(port) if is_serving else (tmp_path / "service.log").exists())
            demo.send_signal(signal.SIGTERM)
            demo.communicate(timeout=PATIENCE_S)
        finally:
            demo.kill()
    assert demo.returncode == 128 + signal.SIGTERM
    assert not answers(port)
    with alone_in(tmp_path / "data"):
        """A service that is left would have the folder."""
