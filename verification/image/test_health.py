"""The image's health check: it follows port, TLS and names, and kills a service that hangs once it has counted."""

import importlib.util
import signal
import socket
import subprocess
import sys

import pytest

from tests.support.access.tls_certificate import make_certificate
from tests.support.repository import ROOT
from tests.support.service.processes import free_port, service_process

FILE = ROOT / "docker/image/health.py"


@pytest.fixture(scope="module")
def health():
    spec = importlib.util.spec_from_file_location("image_health", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


WAYS = {
    "as it is": {},
    "with names": {"TIDEGATE_ALLOWED_HOSTS": "gating.example,other.example"},
    "with TLS": {"tls": True},
    "with TLS and names": {"tls": True, "TIDEGATE_ALLOWED_HOSTS": "gating.example"},
}


@pytest.mark.parametrize("way", WAYS)
def test_a_service_that_answers_is_healthy_however_it_is_set_up(tmp_path, health, way):
    environment = {key: value for key, value in WAYS[way].items() if key != "tls"}
    port, data = free_port(), tmp_path / "data"
    if "tls" in WAYS[way]:
        cert, key = make_certificate(tmp_path)
        environment |= {"TIDEGATE_TLS_CERT": str(cert), "TIDEGATE_TLS_KEY": str(key)}
    names = environment.get("TIDEGATE_ALLOWED_HOSTS")
    served = environment | ({"TIDEGATE_ALLOWED_HOSTS": f"{names},127.0.0.1"} if names else {})
    arguments = ("tests.support.service.self_driving_program", str(data), str(tmp_path), str(port))
    certificate = tmp_path / "cert.pem" if "tls" in WAYS[way] else None
    with service_process(*arguments, port=port, log=tmp_path / "log", environment=served, certificate=certificate):
        assert health.trouble_of({"TIDEGATE_PORT": str(port), **environment}, None) is None
        assert health.trouble_of(environment, port) is None, "a port of the command's comes first"
        if certificate is not None:
            assert "no answer" in health.trouble_of({"TIDEGATE_PORT": str(port)}, None), "plain HTTP to TLS"
        if names:
            assert health.trouble_of({"TIDEGATE_ALLOWED_HOSTS": "foreign.example", **_tls(environment)}, port) == (
                "answered with 421"
            )


def _tls(environment):
    return {name: value for name, value in environment.items() if "TLS" in name}


def test_where_nothing_or_no_one_answers_it_is_not_healthy(health, monkeypatch):
    assert "no answer" in health.trouble_of({"TIDEGATE_PORT": str(free_port())}, None)
    monkeypatch.setattr(health, "TIMEOUT_S", 0.2)
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        assert "no answer" in health.trouble_of({}, silent.getsockname()[1])


@pytest.fixture
def service_like(tmp_path, health, monkeypatch):
    """A process of the service's words, and no other to be found by them."""
    script = tmp_path / "tidegate"
    script.write_text("import signal\nprint('up', flush=True)\nsignal.pause()\n")
    process = subprocess.Popen([sys.executable, str(script), "serve", "--port", "8123"], stdout=subprocess.PIPE)
    process.stdout.readline()
    found = health.services()
    assert process.pid in found
    monkeypatch.setattr(health, "services", lambda: [process.pid])
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_service_is_killed_at_the_third_failure_in_a_row_and_not_before(tmp_path, health, service_like):
    state = tmp_path / "state"
    for is_healthy in (True, False, False, True, False, False):
        health._count(state, 3, is_healthy=is_healthy)
        assert service_like.poll() is None
    health._count(state, 3, is_healthy=False)
    assert service_like.wait(10.0) == -signal.SIGKILL
    assert not state.exists(), "the next start has its own time"


def test_a_service_that_has_not_answered_yet_is_left_alone(tmp_path, health, service_like):
    for _ in range(10):
        health._count(tmp_path / "state", 3, is_healthy=False)
    assert service_like.poll() is None


def test_it_needs_the_standard_library_only():
    done = subprocess.run(
        [sys.executable, "-IS", str(FILE)],
        env={"TIDEGATE_PORT": str(free_port())},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (1, "")
    assert done.stdout.startswith("no answer")
