"""A Dask cluster of real processes over TLS: a scheduler and workers, started, waited for, and always ended."""

import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.support.audit.syslog_certificates import Authority, Pair
from tests.support.waiting import PATIENCE_S, eventually

START_S = 120.0
OTHER_VERSION = "import engine; engine.__version__ = '0.1.0'; "
WORKER = "from distributed.cli.dask_worker import main; main()"
SCHEDULER = "from distributed.cli.dask_scheduler import main; main()"


class Cluster:
    """A scheduler, its workers by name, and what a client needs to reach them."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        authority = Authority(folder, "cluster")
        self.authority = authority.file
        self.client: Pair = authority.pair("client")
        self._server: Pair = authority.pair("localhost")
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._schedulers: list[subprocess.Popen[bytes]] = []
        port = ["--host", "tls://127.0.0.1", "--port", "0", "--no-dashboard", "--no-show"]
        self._schedulers.append(self._start("scheduler", SCHEDULER, port))
        eventually(lambda: "Scheduler at:" in self.log("scheduler"), within_s=START_S)
        self.address = re.findall(r"Scheduler at:\s+(tls://\S+)", self.log("scheduler"))[0]

    @property
    def options(self) -> list[str]:
        """Return the options of a command for this cluster."""
        files = ["--tls-ca", str(self.authority), "--tls-cert", str(self.client.cert), "--tls-key"]
        return ["--scheduler", self.address, *files, str(self.client.key)]

    def add_worker(self, name: str, *, threads: int = 1, before: str = "", folder: Path | None = None) -> None:
        """Start a worker and wait until it is registered; ``before`` is Python that runs first."""
        options = [self.address, "--name", name, "--nthreads", str(threads), "--no-nanny", "--no-dashboard"]
        scratch = ["--local-directory", str(self._folder / "scratch"), "--death-timeout", "60"]
        self._processes[name] = self._start(name, before + WORKER, [*options, *scratch], folder)
        eventually(lambda: "Registered to:" in self.log(name), within_s=START_S)

    def kill(self, name: str) -> None:
        """Kill a worker with SIGKILL."""
        self._processes[name].kill()
        self._processes[name].wait(PATIENCE_S)

    def kill_scheduler(self) -> None:
        """Kill the scheduler with SIGKILL."""
        self._schedulers[0].kill()

    def is_running(self, name: str) -> bool:
        """Whether a worker's process is there."""
        return self._processes[name].poll() is None

    def log(self, name: str) -> str:
        """Return what a process has printed."""
        return (self._folder / f"{name}.log").read_text()

    def end(self) -> None:
        """End every process."""
        for process in [*self._processes.values(), *self._schedulers]:
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
            process.wait(PATIENCE_S)

    def _start(self, name: str, code: str, options: list[str], folder: Path | None = None) -> subprocess.Popen[bytes]:
        files = ["--tls-ca-file", self.authority, "--tls-cert", self._server.cert, "--tls-key", self._server.key]
        with (self._folder / f"{name}.log").open("wb") as log:
            return subprocess.Popen(
                [sys.executable, "-W", "ignore", "-c", code, *options, *map(str, files)],
                stdout=log,
                stderr=subprocess.STDOUT,
                cwd=folder or self._folder,
                env=os.environ | {"DASK_DISTRIBUTED__LOGGING__DISTRIBUTED": "info"},
            )


@contextlib.contextmanager
def started_cluster(folder: Path, *workers: str) -> Iterator[Cluster]:
    """Yield a cluster with workers of these names."""
    folder.mkdir()
    cluster = Cluster(folder)
    try:
        for name in workers:
            cluster.add_worker(name)
        yield cluster
    finally:
        cluster.end()
