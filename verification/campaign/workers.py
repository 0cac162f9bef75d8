"""Workers that do a campaign's trials side by side, each with a bench of its own."""

import ctypes
import multiprocessing
import os
import queue
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from verification.campaign.bench import Bench, Kept, Trial

DIES_WITH_ITS_PARENT = 1
"""Linux, prctl: a signal when the parent ends."""


def run(
    turns: Sequence[Sequence[Trial]], make: Callable[[Path], Bench[Trial, Kept]], folder: Path, jobs: int
) -> Iterator[Kept]:
    """Do all turns with so many benches side by side; yield outcomes as they come. Closing the generator ends them.

    Parameters
    ----------
    turns
        What a worker does at one go; neighbours may share a rig.
    make
        Makes a bench in a folder; it is sent to another process.
    """
    if not turns:
        return
    context = multiprocessing.get_context("spawn")
    waiting: multiprocessing.Queue[Sequence[Trial] | None] = context.Queue()
    found: multiprocessing.Queue[Kept | None] = context.Queue()
    for turn in [*turns, *[None] * jobs]:
        waiting.put(turn)
    workers = [
        context.Process(target=_work, args=(make, folder / f"worker-{number}", waiting, found))
        for number in range(jobs)
    ]
    for worker in workers:
        worker.start()
    try:
        yield from _collect(workers, found)
    finally:
        for worker in workers:
            worker.terminate()
        for worker in workers:
            worker.join()


def _collect(workers: Sequence[Any], found: "multiprocessing.Queue[Kept | None]") -> Iterator[Kept]:
    left = len(workers)
    while left:
        try:
            outcome = found.get(timeout=5.0)
        except queue.Empty:
            if not any(worker.is_alive() for worker in workers):
                return  # they died without a word: what they did not do is missing in the table
            continue
        if outcome is None:
            left -= 1
        else:
            yield outcome


def _work(
    make: Callable[[Path], Bench[Trial, Kept]],
    folder: Path,
    waiting: "multiprocessing.Queue[Sequence[Trial] | None]",
    found: "multiprocessing.Queue[Kept | None]",
) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the one who asked ends the campaign
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what is mounted and started is let go of
    ctypes.CDLL(None).prctl(DIES_WITH_ITS_PARENT, signal.SIGTERM)
    _write_noise_to(folder.with_suffix(".log"))
    bench = make(folder)
    try:
        while (turn := waiting.get()) is not None:
            for trial in turn:
                found.put(bench.try_one(trial))
    finally:
        bench.end()
        found.put(None)


def _write_noise_to(path: Path) -> None:
    """Keep what the processes of this worker say of their troubles, which are made on purpose, off the screen."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as log:
        os.dup2(log.fileno(), sys.stderr.fileno())
