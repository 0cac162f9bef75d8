"""The fault campaign's rig, with what a kill needs: a window that makes edges, starts that no one waits for."""

import os
import shutil
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import SecretStr

from service.core.settings.settings import Settings
from service.storage.files.journals import Journals
from tests.support.repository import ROOT
from verification.faults.operator import PersonGaveUpError
from verification.faults.plan import DEFAULT_PLAN
from verification.faults.rig import DATABASE, MEMORY, Rig, Template
from verification.faults.verdict import LineEdge

EDGE_MM = 4.0
"""A breath leaves this window on both sides of wherever the zero was set, or on one."""

HALF_WRITTEN = (".partial", ".arrows", ".tmp", ".journal")
OPENED_WITHIN_S = 20.0
START_S = 4.0
URL_NAME = "TIDEGATE_DATABASE_URL"
WAITS = 5


class KillRig(Rig):
    """See the module; a context manager."""

    def __init__(self, folder: Path, template: Template, database_url: str | None = None) -> None:
        plan = DEFAULT_PLAN if database_url is None else replace(DEFAULT_PLAN, settings={"DATABASE_URL": database_url})
        super().__init__(folder, plan, template)
        self._database_url = database_url
        self.window = {**self.window, "lower_mm": -EDGE_MM, "upper_mm": EDGE_MM}

    def fill_data(self) -> None:
        """Put what was learned into the data folder; into another database by way of a backup."""
        if self._database_url is None:
            super().fill_data()
            return
        assert self.template is not None
        copy = self.folder / "learned.backup"
        mine = {name: value for name, value in os.environ.items() if name != URL_NAME}
        for words, environment in (
            (("backup", str(copy), "--data", str(self.template.folder), "--no-verify"), mine),
            (("restore", str(copy), "--data", str(self.data)), {**mine, URL_NAME: self._database_url}),
        ):
            command = [sys.executable, "-m", "service.cli", *words]
            subprocess.run(command, cwd=ROOT, env=environment, check=True, stdout=subprocess.DEVNULL)
        copy.unlink()

    @property
    def service_settings(self) -> Settings | None:
        """Where the service's database is."""
        if self._database_url is None:
            return None
        return Settings(data_dir=self.data, database_url=SecretStr(self._database_url))

    def start_service(self) -> None:
        """Start it, and wait for it however long this machine takes; one that ends by itself is not waited for."""
        self.begin_service()
        for turn in range(WAITS):
            try:
                self.person.wait_for_service(lambda: self.is_alive)
            except PersonGaveUpError:
                if not self.is_alive or turn == WAITS - 1:
                    raise
            else:
                return

    @property
    def session_body(self) -> dict[str, Any]:
        return {"source": {"kind": "device", "uri": None}, "window": self.window, **self.session_request}

    @property
    def newest_edge(self) -> LineEdge | None:
        """The receiver's last word, without all those before it."""
        seen = self.receiver.seen
        if not seen:
            return None
        words = seen[-1]
        return LineEdge(is_on=words[0] == "on", at_ns=int(words[1]))

    def await_opened_data(self, then_s: float) -> None:
        """Wait until a start writes to the database, and a while more; at most for as long as a start may take.

        A server's database shows nothing from outside: there the moment is any of a start's.
        """
        if self._database_url is not None:
            time.sleep(START_S * then_s)
            return
        before = self._written
        end_s = time.monotonic() + OPENED_WITHIN_S
        while time.monotonic() < end_s and self.is_alive and self._written == before:
            time.sleep(0.002)
        time.sleep(then_s)

    @property
    def _written(self) -> tuple[int, int] | None:
        try:
            found = (self.data / "tidegate.db-wal").stat()
        except OSError:
            return None
        return found.st_ino, found.st_size

    @property
    def database_trouble(self) -> str:
        """What SQLite itself says of its file; a server was not killed, and is not asked."""
        if self._database_url is not None:
            return ""
        with closing(sqlite3.connect(f"file:{self.data / DATABASE}?mode=ro", uri=True, timeout=20.0)) as database:
            found = [str(row[0]) for row in database.execute("PRAGMA integrity_check") if row[0] != "ok"]
            found += [f"a row of {row[0]} points nowhere" for row in database.execute("PRAGMA foreign_key_check")]
        return "; ".join(found)

    @contextmanager
    def backup(self) -> Iterator[subprocess.Popen[bytes]]:
        """Make a backup beside the service; what it has made when the block ends is thrown away."""
        out = self.folder / "backup"
        command = [sys.executable, "-m", "service.cli", "backup", str(out), "--data", str(self.data), "--no-verify"]
        with (self.folder / "backup.log").open("wb") as log:
            process = subprocess.Popen(command, cwd=ROOT, env=self._environment(), stdout=log, stderr=log)
        try:
            yield process
        finally:
            process.kill()
            process.wait()
            for left in self.folder.glob("backup*"):
                left.unlink()

    def empty_data(self) -> None:
        """Leave the folder as it is before the first start of all; what was there comes back by :meth:`refill_data`."""
        shutil.copytree(self.data, self._aside)
        _clear(self.data)

    def refill_data(self) -> None:
        """Put back what was there."""
        if self._aside.exists():
            _clear(self.data)
            shutil.copytree(self._aside, self.data, dirs_exist_ok=True)
            shutil.rmtree(self._aside)

    @property
    def _aside(self) -> Path:
        return self.folder / "aside"

    @property
    def leftovers(self) -> tuple[str, ...]:
        """What is half written, while no session runs: in the data folder, and journals wherever they lie."""
        inside = [str(path.relative_to(self.data)) for path in self.data.rglob("*") if path.name.endswith(HALF_WRITTEN)]
        return tuple(sorted({*inside, *(path.name for path in Journals(self.data, None, memory=MEMORY).left_behind())}))

    def close_open_sessions(self) -> None:
        """Stop what a kill left created: there may be one open session only."""
        for item in self.person.get("/sessions").json()["items"]:
            if item["status"] in {"created", "running"}:
                self.person.session_id = item["id"]
                if self.person.act("stop").status_code >= 400:
                    raise PersonGaveUpError("a session that is open cannot be stopped")


def _clear(folder: Path) -> None:
    for path in folder.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
