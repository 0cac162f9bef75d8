"""Service processes for tests: with people in their data folder, started, waited for, and always ended."""

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import httpx2

from service.access.permissions import Role
from tests.service.people import EVERY_ROLE, SOMEBODY, Provisioned, provision

ROOT = Path(__file__).parents[2]
START_S = 30.0
PEOPLE: Mapping[str, frozenset[Role]] = dict.fromkeys((SOMEBODY, "A. Physicist", "B. Physicist"), EVERY_ROLE)
"""Whom the tests of this project speak as."""


class PeopleOverHttp(httpx2.Client):
    """A client that speaks as the person whom its request names, else as the first; as nobody without people.

    Attributes
    ----------
    key_headers
        Those of an API key: for sockets, and wherever a program calls.
    """

    def __init__(self, port: int, provisioned: Provisioned | None = None, *, timeout_s: float = 20.0) -> None:
        super().__init__(base_url=f"http://127.0.0.1:{port}", timeout=timeout_s)
        self._people = provisioned.people if provisioned else {}
        self._first = provisioned.headers if provisioned else {}
        self.key_headers = provisioned.key if provisioned else {}

    def request(self, method: str, url: Any, **options: Any) -> httpx2.Response:
        mine = self._people.get(_named(options), self._first)
        options["headers"] = {**mine, **(options.get("headers") or {})}
        return super().request(method, url, **options)


def _named(options: Mapping[str, Any]) -> str:
    told = [options.get("json"), options.get("params")]
    names = [one.get("operator") for one in told if isinstance(one, dict)]
    return next((name for name in names if isinstance(name, str)), "")


def provisioned_for(data: Path, port: int) -> Provisioned:
    """Put the people of the tests into a data folder, logged in on the page of the service of this port."""
    return provision(data, people=PEOPLE, origin=f"http://127.0.0.1:{port}")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def service_process(
    *arguments: str, port: int, log: Path, environment: dict[str, str] | None = None, data: Path | None = None
) -> Iterator[tuple[subprocess.Popen, PeopleOverHttp]]:
    """Run a Python module as a service until the block ends; killed if it still lives then.

    With its ``data`` folder given, the client speaks as people who are logged in there; else as nobody.
    """
    provisioned = None if data is None else provisioned_for(data, port)
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=ROOT,
            env={**os.environ, "TIDEGATE_JOURNAL_DIR": str(log.parent / "journals"), **(environment or {})},
        )
        try:
            with PeopleOverHttp(port, provisioned) as client:
                _wait_until_it_answers(process, client, log)
                yield process, client
        finally:
            if process.poll() is None:
                process.kill()
            process.wait()


def _wait_until_it_answers(process: subprocess.Popen, client: httpx2.Client, log: Path) -> None:
    end_s = time.monotonic() + START_S
    while True:
        with contextlib.suppress(httpx2.TransportError):
            if client.get("/healthz").status_code == 200:
                return
        assert process.poll() is None, log.read_text()
        assert time.monotonic() < end_s, log.read_text()
        time.sleep(0.05)
