"""A PostgreSQL server of the tests' own: Debian's programs, a folder of its own, gone when the tests are.

A server a test process (pytest-xdist's workers are two), started when the first test asks for it. It has nothing to do
with a cluster of the machine's. It dies with the process that started it, however that ends.
"""

import contextlib
import os
import pwd
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import psycopg
import pytest
from sqlalchemy import URL

from service.storage.database.engine import Database
from tests.support.temporary_folder import temporary_root

HOMES = Path("/usr/lib/postgresql")
PREFIX = "tidegate-postgres-"
OWNER = "tidegate"
PASSWORD = "tests only"
TEMPLATE = "migrated"
# The data of tests has nothing to lose: nothing waits for a disk.
SETTINGS = {
    "listen_addresses": "127.0.0.1",
    "fsync": "off",
    "full_page_writes": "off",
    "synchronous_commit": "off",
    "shared_buffers": "32MB",
    "max_connections": "100",
    "autovacuum": "off",
    "log_min_messages": "fatal",
}


def _programs() -> Path:
    found = sorted(HOMES.glob("*/bin/postgres"), key=lambda path: int(path.parent.parent.name))
    if not found:
        pytest.fail("PostgreSQL's programs are missing: apt-get install postgresql")
    return found[-1].parent


def _unprivileged() -> list[str]:
    """PostgreSQL refuses to run as root: the words that make it somebody else's."""
    if os.getuid() != 0:
        return []
    return ["--reuid=postgres", "--regid=postgres", "--clear-groups"]


class PostgresServer:
    """A running server; `kill`, `stop`, `start`, `pause` and `go_on` do to it what happens in the world.

    Parameters
    ----------
    settings
        Settings of PostgreSQL beside and over SETTINGS.
    network
        The words before the command that start it in another network; its socket's file is reached all the same.
    root
        Where its folder is made: a disk of its own, to be filled.
    """

    def __init__(
        self, settings: Mapping[str, str] | None = None, *, network: Sequence[str] = (), root: Path | None = None
    ) -> None:
        self._programs = _programs()
        self._settings = {**SETTINGS, **(settings or {})}
        self._network = list(network)
        self.folder = Path(tempfile.mkdtemp(prefix=f"{PREFIX}{os.getpid()}-", dir=root or temporary_root()))
        self.port = _free_port()
        self._count = 0
        self._process: subprocess.Popen[bytes] | None = None
        if os.getuid() == 0:
            owner = pwd.getpwnam("postgres")
            os.chown(self.folder, owner.pw_uid, owner.pw_gid)
        self._initialise()
        self.start()
        self._create("CREATE DATABASE " + TEMPLATE)
        database = Database(self.url(TEMPLATE))
        database.migrate()
        database.close()

    def _initialise(self) -> None:
        secret = self.folder / "password"
        secret.write_text(PASSWORD)
        secret.chmod(0o644)
        names = ["-D", str(self.folder / "data"), "-U", OWNER, "--pwfile", str(secret)]
        ways = ["--auth-local=trust", "--auth-host=scram-sha-256", "--no-sync"]
        # A server of people who read: text is ordered as in a dictionary, and not by its bytes.
        ways += ["--encoding=UTF8", "--locale=C.UTF-8", "--locale-provider=icu", "--icu-locale=en-US"]
        words = _unprivileged()
        prefix = ["setpriv", *words] if words else []
        made = subprocess.run(
            [*prefix, str(self._programs / "initdb"), *names, *ways], capture_output=True, check=False
        )
        assert made.returncode == 0, made.stderr.decode()

    def start(self) -> None:
        """Start it, and wait until it answers."""
        settings = [f"--{name}={value}" for name, value in self._settings.items()]
        where = ["-D", str(self.folder / "data"), "-p", str(self.port), "-k", str(self.folder)]
        words = [
            *self._network,
            "setpriv",
            *_unprivileged(),
            "--pdeathsig=QUIT",
            self._programs / "postgres",
            *where,
            *settings,
        ]
        own_home = {**os.environ, "HOME": str(self.folder)}  # where it looks for a client's certificate
        with (self.folder / "log").open("ab") as log:
            self._process = subprocess.Popen(words, env=own_home, stdout=subprocess.DEVNULL, stderr=log)
        end_s = time.monotonic() + 30.0
        while True:
            try:
                self._connect().close()
            except psycopg.OperationalError:
                assert self._process.poll() is None, (self.folder / "log").read_text()
                assert time.monotonic() < end_s, "PostgreSQL does not start"
                time.sleep(0.02)
            else:
                return

    @property
    def is_running(self) -> bool:
        """Whether its first process lives."""
        return self._process is not None and self._process.poll() is None

    @property
    def process_id(self) -> int:
        """The first process of the server that runs."""
        assert self._process is not None
        return self._process.pid

    def start_as_standby(self) -> None:
        """Start it as one that follows another and takes no writing."""
        (self.folder / "data" / "standby.signal").touch()
        self.start()

    def promote(self) -> None:
        """Let a standby take over."""
        self._create("SELECT pg_promote()")

    def kill(self) -> None:
        """End it, and all that serve its connections, at once."""
        self._signal_all(signal.SIGKILL)
        self._reap()

    def stop(self) -> None:
        """Shut it down as an administrator does in a hurry: connections are reported."""
        assert self._process is not None
        self._process.send_signal(signal.SIGINT)
        self._reap()

    def pause(self) -> None:
        """Let it be there and answer nothing."""
        self._signal_all(signal.SIGSTOP)

    def go_on(self) -> None:
        """Let it answer again."""
        self._signal_all(signal.SIGCONT)

    def _reap(self) -> None:
        assert self._process is not None
        self._process.wait(timeout=30.0)
        (self.folder / "data" / "postmaster.pid").unlink(missing_ok=True)

    def _signal_all(self, number: int) -> None:
        assert self._process is not None
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()
        for pid in [self._process.pid, *map(int, children)]:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, number)

    def url(self, database: str) -> URL:
        """Name a database through the server's socket, which asks for no password."""
        query = {"host": str(self.folder), "port": str(self.port)}
        return URL.create("postgresql+psycopg", username=OWNER, database=database, query=query)

    def tcp_url(self, database: str, *, password: str | None = PASSWORD) -> URL:
        """Name a database over TCP, which asks for the password."""
        return URL.create(
            "postgresql+psycopg", username=OWNER, password=password, host="127.0.0.1", port=self.port, database=database
        )

    def empty(self) -> URL:
        """Make a database without any table."""
        return self._new("template0")

    def migrated(self) -> URL:
        """Make a database with the newest tables."""
        return self._new(TEMPLATE)

    def _new(self, template: str) -> URL:
        self._count += 1
        name = f"test_{self._count}"
        # By files: by the log, the default, takes twice the time.
        self._create(f"CREATE DATABASE {name} TEMPLATE {template} STRATEGY file_copy")
        return self.url(name)

    def drop(self, url: URL) -> None:
        """Remove a database despite open connections."""
        self._create(f"DROP DATABASE IF EXISTS {url.database} WITH (FORCE)")

    def _create(self, statement: str) -> None:
        with contextlib.closing(self._connect()) as connection:
            connection.autocommit = True
            connection.execute(statement.encode())

    def _connect(self) -> psycopg.Connection:
        return psycopg.connect(host=str(self.folder), port=self.port, user=OWNER, dbname="postgres")

    def close(self) -> None:
        """End it and remove all of it."""
        if self._process is not None and self._process.poll() is None:
            self._signal_all(signal.SIGCONT)
            self._process.send_signal(signal.SIGQUIT)
            self._process.wait(timeout=30.0)
        shutil.rmtree(self.folder, ignore_errors=True)


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def remove_leftovers() -> None:
    """Remove the folders of servers whose test process was killed; the servers ended with it."""
    for folder in temporary_root().glob(f"{PREFIX}*"):
        owner = folder.name.removeprefix(PREFIX).partition("-")[0]
        if owner.isdigit() and not Path(f"/proc/{owner}").exists():
            shutil.rmtree(folder, ignore_errors=True)
