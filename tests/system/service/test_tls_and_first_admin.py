"""A real `tidegate serve`: its TLS, and the first administrator's password, shown once."""

import os
import re
import shutil
import signal
import socket
import ssl
import subprocess
import sys
from contextlib import contextmanager
from datetime import timedelta

import httpx2
import pytest
from typer.testing import CliRunner

from service.cli import app as command_line
from service.core.settings.settings import Settings
from service.web.app import create_app
from service.web.server import make_server
from tests.support.access.tls_certificate import make_certificate
from tests.support.repository import ROOT
from tests.support.service.processes import free_port
from tests.support.waiting import eventually


@contextmanager
def served(folder, *, environment=None, ready="listening on"):
    """Run the command until the block ends; gives its port and what it said."""
    port = free_port()
    log = folder / f"log {port}"
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "service.cli", "serve", "--port", str(port), "--data", str(folder / "data")],
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=ROOT,
            env={**os.environ, **(environment or {})},
        )
    try:

        def is_ready() -> bool:
            assert process.poll() is None, log.read_text()
            return ready in log.read_text()

        eventually(is_ready, within_s=60.0, pause_s=0.05, detail=log.read_text)
        yield port, log
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 0
    finally:
        if process.poll() is None:
            process.kill()
        process.wait()


@pytest.fixture(scope="module")
def tls(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tls")
    cert, key = make_certificate(folder)
    environment = {"TIDEGATE_TLS_CERT": str(cert), "TIDEGATE_TLS_KEY": str(key)}
    with served(folder, environment=environment) as (port, log):
        yield port, log, cert, folder


def test_the_first_password_is_shown_once_and_has_to_be_changed_over_tls(tls):
    port, log, cert, folder = tls
    password = re.search(r"^    (\S{20})$", log.read_text(), re.MULTILINE)[1]
    url = f"https://127.0.0.1:{port}"
    with httpx2.Client(base_url=url, verify=ssl.create_default_context(cafile=cert), headers={"Origin": url}) as client:
        answer = client.post("/api/v1/login", json={"name": "admin", "password": password})
        assert answer.status_code == 200, answer.text
        assert answer.json()["must_change_password"] is True
        cookie = answer.headers["set-cookie"]
        assert cookie.startswith("__Host-tidegate_login=")
        assert "secure" in cookie.lower()
        assert client.get("/api/v1/users").status_code == 403
        change = {"old_password": password, "new_password": "one that I chose myself"}
        assert client.post("/api/v1/me/password", json=change).status_code == 204
        assert client.get("/api/v1/users").status_code == 200
        rows = client.get("/api/v1/audit").text
    assert password not in rows
    for file in (folder / "data").rglob("*"):
        assert not file.is_file() or password.encode() not in file.read_bytes(), file
    assert log.read_text().count(password) == 1


def test_a_page_without_tls_gets_nothing(tls):
    with httpx2.Client() as client, pytest.raises(httpx2.TransportError):
        client.get(f"http://127.0.0.1:{tls[0]}/healthz")


@pytest.mark.parametrize(("newest", "is_spoken"), [("TLSv1_1", False), ("TLSv1_2", True), ("TLSv1_3", True)], ids=str)
def test_nothing_older_than_tls_1_2_is_spoken(tls, newest, is_spoken):
    context = ssl.create_default_context(cafile=tls[2])
    context.set_ciphers("ALL:@SECLEVEL=0")
    with _no_warning_of_old_versions():
        context.minimum_version = ssl.TLSVersion.TLSv1
        context.maximum_version = ssl.TLSVersion[newest]
    with socket.create_connection(("127.0.0.1", tls[0]), timeout=10.0) as raw:
        if is_spoken:
            with context.wrap_socket(raw, server_hostname="127.0.0.1") as spoken:
                assert spoken.version() == newest.replace("_", ".")
        else:
            with pytest.raises((ssl.SSLError, ConnectionError)):
                context.wrap_socket(raw, server_hostname="127.0.0.1")


@contextmanager
def _no_warning_of_old_versions():
    import warnings

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        yield


REFUSED = {
    "missing": "No such file",
    "not a certificate": "cert.pem",
    "ended": "the certificate ended on",
    "other key": "the key does not belong to the certificate",
    "passphrase": "the key has a passphrase",
}


def broken_certificate(tmp_path, broken):
    """Return the settings of a certificate that cannot be used."""
    cert, key = make_certificate(tmp_path)
    if broken == "missing":
        cert.unlink()
    elif broken == "not a certificate":
        cert.write_text("nothing")
    elif broken == "ended":
        make_certificate(tmp_path, ends_in=-timedelta(minutes=1))
    elif broken == "passphrase":
        make_certificate(tmp_path, passphrase="secret")
    else:
        (tmp_path / "other").mkdir()
        shutil.copy(make_certificate(tmp_path / "other")[1], key)
    return {"TIDEGATE_TLS_CERT": str(cert), "TIDEGATE_TLS_KEY": str(key)}


@pytest.mark.parametrize("broken", REFUSED)
def test_a_certificate_that_cannot_be_used_is_stated_in_one_line(tmp_path, broken):
    words = ["serve", "--port", str(free_port()), "--data", str(tmp_path / "data")]
    done = CliRunner().invoke(command_line, words, env=broken_certificate(tmp_path, broken))
    assert done.exit_code == 2
    assert "cannot be used for TLS" in done.stderr.splitlines()[-1]
    assert REFUSED[broken] in done.stderr.splitlines()[-1]


def test_a_process_whose_certificate_cannot_be_used_ends_without_a_traceback(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "service.cli", "serve", "--port", str(free_port()), "--data", str(tmp_path / "data")],
        env={**os.environ, **broken_certificate(tmp_path, "other key")},
        cwd=ROOT,
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert REFUSED["other key"] in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr


def test_the_oldest_version_does_not_depend_on_what_the_system_refuses_anyway(tmp_path):
    cert, key = make_certificate(tmp_path)
    app = create_app(Settings(data_dir=tmp_path, tls_cert=cert, tls_key=key))
    server = make_server(app, host="127.0.0.1", port=0, certificate=app.state.certificate)
    assert server.config.ssl.minimum_version is ssl.TLSVersion.TLSv1_2
