"""The campaign: kills side by side, each worker with a rig of its own, and one place that writes them down."""

import contextlib
import ctypes
import multiprocessing
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import dataclass, replace
from multiprocessing.util import Finalize
from pathlib import Path

from sqlalchemy import URL

from tests.support.database.postgres import PostgresServer
from verification.faults.outcomes import OutcomeFile
from verification.faults.rig import WORN_MB, Template
from verification.faults.service_program import DIES_WITH_ITS_PARENT
from verification.faults.template import learned
from verification.kills.moments import moment_of
from verification.kills.rig import KillRig
from verification.kills.trial import run_trial
from verification.kills.verdict import Outcome, Trouble

FILE_NAME = "kills.jsonl"
STARTING = "starting"
ATTEMPTS = 2
"""A rig that broke in a way no one foresaw is replaced, and the kill done once more; the first's story is kept."""


def kept_in(folder: Path) -> OutcomeFile[Outcome]:
    """Return the campaign's memory."""
    return OutcomeFile(folder / FILE_NAME, Outcome, lambda outcome: outcome.number)


class Bench:
    """One worker's place: one rig at a time, kept for as long as it is good for the next kill."""

    def __init__(self, folder: Path, template: Template, *, is_postgresql: bool = False) -> None:
        self._folder, self._template = folder, template
        self._server = PostgresServer() if is_postgresql else None
        self._held = contextlib.ExitStack()
        self._rig: KillRig | None = None
        self._rigs = 0

    def kill(self, number: int, seed: int, code: str | None = None) -> Outcome:
        """Do one kill of the campaign."""
        moment = moment_of(number, seed, code)
        if moment.is_fresh and self._server is not None:
            moment = moment_of(number, seed, STARTING)  # the first start of all is SQLite's: it makes the file
        stories: list[str] = []
        for _ in range(ATTEMPTS):
            try:
                outcome = run_trial(self._a_rig(), moment, number, seed)
            except Exception:  # noqa: BLE001 - whatever broke, the next kill has to go on
                stories.append(traceback.format_exc(limit=-3))
                self.clear()
            else:
                if outcome.is_red:
                    self.clear()
                return replace(outcome, note="\n".join([*stories, outcome.note]).strip())
        return Outcome(number=number, moment=moment.code, troubles=(Trouble.NO_RESULT,), note="\n".join(stories))

    def clear(self) -> None:
        """Let go of everything that was started and mounted."""
        self._rig = None
        held, self._held = self._held, contextlib.ExitStack()
        held.close()

    def end(self) -> None:
        """Let go of everything, the server too."""
        self.clear()
        if self._server is not None:
            self._server.close()

    def _a_rig(self) -> KillRig:
        if self._rig is not None and self._rig.worn_mb > WORN_MB:
            self.clear()
        if self._rig is None:
            self._rigs += 1
            url = None if self._server is None else _plain(self._server.empty())
            self._rig = self._held.enter_context(KillRig(self._folder / str(self._rigs), self._template, url))
        return self._rig


def _plain(url: URL) -> str:
    return url.set(drivername="postgresql").render_as_string(hide_password=False)


@dataclass(slots=True)
class _Worker:
    """What a worker process has; one a process, made when it begins."""

    bench: Bench


_workers: list[_Worker] = []


def run(
    numbers: Sequence[int], *, seed: int, jobs: int, code: str | None = None, is_postgresql: bool = False
) -> Iterator[Outcome]:
    """Do these kills with this many rigs in parallel; yield outcomes as they come. Closing the generator ends them."""
    if not numbers:
        return
    with tempfile.TemporaryDirectory(prefix="tidegate-kills-") as folder:
        template = learned(Path(folder) / "template")
        context = multiprocessing.get_context("spawn")
        begin = (_begin, (folder, template, is_postgresql))
        with ProcessPoolExecutor(jobs, mp_context=context, initializer=begin[0], initargs=begin[1]) as pool:
            waiting = list(numbers)
            running: set[Future[Outcome]] = set()
            try:
                while waiting or running:
                    while waiting and len(running) < jobs:
                        running.add(pool.submit(_kill, waiting.pop(0), seed, code))
                    done, running = wait(running, return_when=FIRST_COMPLETED)
                    yield from (one.result() for one in done)
            finally:
                waiting.clear()


def _begin(folder: str, template: Template, is_postgresql: bool) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one who asked ends the campaign; a kill that began is finished
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    ctypes.CDLL(None).prctl(DIES_WITH_ITS_PARENT, signal.SIGKILL)
    place = Path(folder) / f"worker-{os.getpid()}"
    with place.with_suffix(".log").open("ab") as log:
        os.dup2(log.fileno(), sys.stderr.fileno())
    bench = Bench(place, template, is_postgresql=is_postgresql)
    Finalize(bench, bench.end, exitpriority=10)  # a worker ends without running what atexit knows
    _workers[:] = [_Worker(bench=bench)]


def _kill(number: int, seed: int, code: str | None) -> Outcome:
    return _workers[0].bench.kill(number, seed, code)
