"""Service processes for tests: with people in their data folder, started, waited for, and always ended."""

import contextlib
import os
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import httpx2

from service.core.permissions import Role
from service.core.settings.settings import Settings
from tests.support.repository import ROOT
from tests.support.service.accounts import EVERY_ROLE, SOMEBODY, Provisioned, provision
from tests.support.site_settings import with_config
from tests.support.waiting import PATIENCE_S, eventually

START_S = 140.0
PEOPLE: Mapping[str, frozenset[Role]] = dict.fromkeys((SOMEBODY, "A. Physicist", "B. Physicist"), EVERY_ROLE)
"""Whom the tests of this project speak as."""


class PeopleOverHttp(httpx2.Client):
    """A client that speaks as the person whom its request names, else as the first; as no one without people.

    Attributes
    ----------
    first
        The headers of the first person's log-in.
    key_headers
        Those of an API key: for sockets, and wherever a program calls.
    trusted
        The certificate that the service shows; None where it speaks plain HTTP.
    """

    def __init__(
        self,
        port: int,
        provisioned: Provisioned | None = None,
        *,
        timeout_s: float = PATIENCE_S,
        certificate: Path | None = None,
    ) -> None:
        self.trusted = None if certificate is None else ssl.create_default_context(cafile=certificate)
        super().__init__(base_url=_origin(port, certificate), timeout=timeout_s, verify=self.trusted or True)
        self._people = provisioned.people if provisioned else {}
        self.first = provisioned.headers if provisioned else {}
        self.key_headers = provisioned.key if provisioned else {}

    def request(self, method: str, url: Any, **options: Any) -> httpx2.Response:
        mine = self._people.get(_named(options), self.first)
        options["headers"] = {**mine, **(options.get("headers") or {})}
        return super().request(method, url, **options)


def _named(options: Mapping[str, Any]) -> str:
    reported = [options.get("json"), options.get("params")]
    names = [one.get("operator") for one in reported if isinstance(one, dict)]
    return next((name for name in names if isinstance(name, str)), "")


def _origin(port: int, certificate: Path | None) -> str:
    return f"{'http' if certificate is None else 'https'}://127.0.0.1:{port}"


def provisioned_for(data: Path, port: int, tls: tuple[Path, Path] | None = None) -> Provisioned:
    """Put the people of the tests into a data folder, logged in on the page of the service of this port."""
    if tls is None:
        return provision(data, people=PEOPLE, origin=_origin(port, None))
    settings = Settings(data_dir=data, tls_cert=tls[0], tls_key=tls[1])
    return provision(data, people=PEOPLE, origin=_origin(port, tls[0]), settings=settings)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def service_process(
    *arguments: str,
    port: int,
    log: Path,
    environment: dict[str, str] | None = None,
    data: Path | None = None,
    tls: tuple[Path, Path] | None = None,
    certificate: Path | None = None,
) -> Iterator[tuple[subprocess.Popen, PeopleOverHttp]]:
    """Run a Python module as a service until the block ends; kill the process if it still runs then.

    With its ``data`` folder given, the client speaks as people who are logged in there; else without a log-in. ``tls``
    is a certificate and its key: the service reads them from its environment, and the client speaks HTTPS. With a
    ``certificate`` alone the client does, and the environment is the caller's.
    """
    provisioned = None if data is None else provisioned_for(data, port, tls)
    spoken = {} if tls is None else {"TIDEGATE_TLS_CERT": str(tls[0]), "TIDEGATE_TLS_KEY": str(tls[1])}
    own = {"TIDEGATE_JOURNAL_DIR": str(log.parent / "journals"), **spoken, **(environment or {})}
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=ROOT,
            env={**os.environ, **with_config(own, log.parent / f"config-{port}")},
        )
        try:
            with PeopleOverHttp(port, provisioned, certificate=certificate if tls is None else tls[0]) as client:
                _wait_until_it_answers(process, client, log)
                yield process, client
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()


def _wait_until_it_answers(process: subprocess.Popen, client: httpx2.Client, log: Path) -> None:
    def answers() -> bool:
        assert process.poll() is None, log.read_text()
        with contextlib.suppress(httpx2.TransportError):
            return client.get("/healthz").status_code == 200
        return False

    eventually(answers, within_s=START_S, pause_s=0.05, detail=log.read_text)
