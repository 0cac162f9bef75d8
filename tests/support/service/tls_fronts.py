"""A service with a session under way that is reached by TLS: its own, or a proxy's in front of it.

The proxies run with the files of `docker/room`; only ports, names and paths are replaced.
"""

import contextlib
import os
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import httpx2

from service.core.settings.settings import Settings
from tests.support.access.tls_certificate import make_certificate
from tests.support.repository import ROOT
from tests.support.service.accounts import PASSWORD, provision
from tests.support.service.api_calls import act, make_calibration, make_session_body, upload
from tests.support.service.processes import PEOPLE, PeopleOverHttp, free_port, service_process
from tests.support.waiting import PATIENCE_S, eventually

FRONTS = ("own", "nginx", "caddy")
NGINX = """daemon off;
user {user};
pid {folder}/nginx.pid;
error_log {folder}/nginx.log;
events {{}}
http {{
    access_log off;
    client_body_temp_path {folder}/body;
    proxy_temp_path {folder}/proxy;
    fastcgi_temp_path {folder}/fastcgi;
    uwsgi_temp_path {folder}/uwsgi;
    scgi_temp_path {folder}/scgi;
    include {folder}/tidegate.conf;
}}
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Front:
    """The service as its users reach it."""

    kind: str
    port: int
    cert: Path
    client: PeopleOverHttp
    session_id: str

    @property
    def url(self) -> str:
        return f"https://127.0.0.1:{self.port}"

    @property
    def trusted(self) -> ssl.SSLContext:
        return ssl.create_default_context(cafile=self.cert)

    def slow_reader(self, path: str) -> ssl.SSLSocket:
        """Open a stream with the smallest receive buffer there is, and read nothing yet."""
        raw = socket.socket()
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        raw.settimeout(PATIENCE_S)
        raw.connect(("127.0.0.1", self.port))
        connection = self.trusted.wrap_socket(raw, server_hostname="127.0.0.1")
        head = [f"GET {path} HTTP/1.1", f"Host: 127.0.0.1:{self.port}"]
        head += [f"{name}: {value}" for name, value in self.client.key_headers.items()]
        if not path.endswith("events"):
            head += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13"]
            head += ["Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="]
        connection.sendall("\r\n".join([*head, "", ""]).encode())
        return connection

    def metric(self, name: str) -> float:
        """Read the sum of a metric's series."""
        text = self.client.get("/metrics", headers=self.client.key_headers).text
        return sum(
            float(line.rpartition(" ")[2]) for line in text.splitlines() if line.split("{")[0].split(" ")[0] == name
        )

    def await_rise(self, name: str, by: float) -> float:
        """Wait until a metric has risen so far; return how long that took [s]."""
        before, began_s = self.metric(name), time.monotonic()
        eventually(
            lambda: self.metric(name) >= before + by,
            within_s=2 * PATIENCE_S,
            pause_s=0.2,
            detail=lambda: f"{name} stays",
        )
        return time.monotonic() - began_s


@contextlib.contextmanager
def fronted(kind: str, folder: Path, **environment: str) -> Iterator[Front]:
    """Run a service behind ``kind`` of `FRONTS` until the block ends; its people have `PASSWORD`."""
    cert, key = make_certificate(folder)
    (folder / "chest.oni").write_bytes(b"not read by the fake engine")
    port, data = free_port(), folder / "data"
    inner = port if kind == "own" else free_port()
    settings = Settings(data_dir=data, tls_cert=cert, tls_key=key)
    people = provision(data, people=PEOPLE, origin=f"https://127.0.0.1:{port}", settings=settings, password=PASSWORD)
    arguments = ("tests.support.service.self_driving_program", str(data), str(folder), str(inner))
    spoken = {"TIDEGATE_TLS_CERT": str(cert), "TIDEGATE_TLS_KEY": str(key)} if kind == "own" else {}
    behind = {} if kind == "own" else {"TIDEGATE_BEHIND_PROXY": "true"}
    with (
        _proxy(kind, folder, port, inner),
        service_process(
            *arguments,
            port=inner,
            log=folder / "log",
            environment={**spoken, **behind, **environment},
            certificate=cert if kind == "own" else None,
        ),
        PeopleOverHttp(port, people, certificate=cert) as client,
    ):
        eventually(lambda: _answers(client), within_s=PATIENCE_S, detail=lambda: f"{kind} does not answer")
        calibration_id = upload(client, make_calibration().to_json()).json()["id"]
        session_id = client.post("/api/v1/sessions", json=make_session_body(calibration_id)).json()["id"]
        assert act(client, session_id, "start").status_code == 200
        yield Front(kind=kind, port=port, cert=cert, client=client, session_id=session_id)


def _answers(client: httpx2.Client) -> bool:
    with contextlib.suppress(httpx2.TransportError):
        return client.get("/healthz").status_code == 200
    return False


@contextlib.contextmanager
def _proxy(kind: str, folder: Path, port: int, inner: int) -> Iterator[None]:
    if kind == "own":
        yield
        return
    executable = shutil.which(kind)
    assert executable is not None, f"not on this machine: apt-get install -y --no-install-recommends {kind}"
    command = _nginx(executable, folder, port, inner) if kind == "nginx" else _caddy(executable, folder, port, inner)
    with (folder / f"{kind}.out").open("wb") as output:
        process = subprocess.Popen(
            command,
            stdout=output,
            stderr=output,
            env={**os.environ, "HOME": str(folder), "XDG_DATA_HOME": str(folder), "XDG_CONFIG_HOME": str(folder)},
        )
        try:
            yield
        finally:
            process.terminate()
            process.wait(PATIENCE_S)


def _nginx(executable: str, folder: Path, port: int, inner: int) -> list[str]:
    site = (ROOT / "docker/room/nginx.conf").read_text(encoding="utf-8")
    own = {
        "listen 443": f"listen 127.0.0.1:{port}",
        "127.0.0.1:8000": f"127.0.0.1:{inner}",
        "/etc/tidegate/tls": folder,
    }
    (folder / "tidegate.conf").write_text(_replaced(site, own))
    user = folder.owner()
    (folder / "nginx.conf").write_text(NGINX.format(folder=folder, user=user))
    return [executable, "-c", str(folder / "nginx.conf"), "-p", str(folder), "-e", str(folder / "nginx.log")]


def _caddy(executable: str, folder: Path, port: int, inner: int) -> list[str]:
    site = (ROOT / "docker/room/Caddyfile").read_text(encoding="utf-8")
    own = {
        "gating.hospital.example:443": f"127.0.0.1:{port}",
        "127.0.0.1:8000": f"127.0.0.1:{inner}",
        "/etc/tidegate/tls": folder,
        "/run/caddy": folder,
    }
    (folder / "Caddyfile").write_text(_replaced(site, own))
    return [executable, "run", "--config", str(folder / "Caddyfile"), "--adapter", "caddyfile"]


def _replaced(text: str, own: dict[str, object]) -> str:
    for shipped, mine in own.items():
        assert shipped in text, shipped
        text = text.replace(shipped, str(mine))
    return text
