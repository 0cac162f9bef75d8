"""Service processes for tests: started, waited for, and always ended."""

import contextlib
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import httpx2

ROOT = Path(__file__).parents[2]
START_S = 30.0


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def service_process(
    *arguments: str, port: int, log: Path, environment: dict[str, str] | None = None
) -> Iterator[tuple[subprocess.Popen, httpx2.Client]]:
    """Run a Python module as a service until the block ends; killed if it still lives then."""
    with log.open("w") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdout=output,
            stderr=subprocess.STDOUT,
            cwd=ROOT,
            env={**os.environ, **(environment or {})},
        )
        try:
            with httpx2.Client(base_url=f"http://127.0.0.1:{port}", timeout=20.0) as client:
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
