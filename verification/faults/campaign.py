"""The campaign: which trials are to be done, workers that do them side by side, and one place that writes them down."""

import contextlib
import multiprocessing
import os
import queue
import signal
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from verification.faults.kinds import FaultKind, all_kinds
from verification.faults.outcomes import OutcomeFile
from verification.faults.plan import Plan
from verification.faults.rig import WORN_MB, Rig, Template
from verification.faults.template import learned
from verification.faults.trial import run_trial
from verification.faults.verdict import Outcome, Recovery, Trouble

FILE_NAME = "outcomes.jsonl"
TRIALS_A_TURN = 10
ATTEMPTS = 2
"""A rig that broke in a way no one foresaw is replaced, and the trial done once more."""


def kept_in(folder: Path) -> OutcomeFile[Outcome]:
    """Return the campaign's memory."""
    return OutcomeFile(folder / FILE_NAME, Outcome, lambda outcome: (outcome.kind, outcome.seed))


@dataclass(frozen=True, slots=True, kw_only=True)
class Turn:
    """What a worker does at one go: a kind, and some seeds."""

    code: str
    seeds: tuple[int, ...]


def turns(kinds: Sequence[FaultKind], seeds: Sequence[int], done: set[tuple[str, int]]) -> list[Turn]:
    """Split what is left to do; kinds that need the same service lie side by side."""
    found = []
    for kind in sorted(kinds, key=lambda one: one.plan.name):
        left = [seed for seed in seeds if (kind.code, seed) not in done]
        found += [
            Turn(code=kind.code, seeds=tuple(left[at : at + TRIALS_A_TURN]))
            for at in range(0, len(left), TRIALS_A_TURN)
        ]
    return found


def run(work: Sequence[Turn], jobs: int) -> Iterator[Outcome]:
    """Do all turns with so many rigs side by side; yields outcomes as they come."""
    if not work:
        return
    with tempfile.TemporaryDirectory(prefix="tidegate-faults-") as folder:
        template = learned(Path(folder) / "template")
        context = multiprocessing.get_context("spawn")
        waiting: multiprocessing.Queue[Turn | None] = context.Queue()
        found: multiprocessing.Queue[Outcome | None] = context.Queue()
        for turn in [*work, *[None] * jobs]:
            waiting.put(turn)
        workers = [
            context.Process(target=_work, args=(Path(folder) / f"worker-{number}", template, waiting, found))
            for number in range(jobs)
        ]
        for worker in workers:
            worker.start()
        try:
            yield from _collect(workers, found)
        finally:
            for worker in workers:
                worker.terminate()
                worker.join()


def _collect(
    workers: Sequence[multiprocessing.Process], found: "multiprocessing.Queue[Outcome | None]"
) -> Iterator[Outcome]:
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
    folder: Path,
    template: Template,
    waiting: "multiprocessing.Queue[Turn | None]",
    found: "multiprocessing.Queue[Outcome | None]",
) -> None:
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(1))  # what is mounted and started is let go of
    _write_noise_to(folder.with_suffix(".log"))
    kinds = {kind.code: kind for kind in all_kinds()}
    bench = Bench(folder, template)
    try:
        while (turn := waiting.get()) is not None:
            for seed in turn.seeds:
                found.put(bench.try_kind(kinds[turn.code], seed))
    finally:
        bench.clear()
        found.put(None)


def _write_noise_to(path: Path) -> None:
    """Keep what the processes of this worker say of their troubles, which are made on purpose, off the screen."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab") as log:
        os.dup2(log.fileno(), sys.stderr.fileno())


class Bench:
    """One worker's place: one rig at a time, kept for as long as it is good for the next trial."""

    def __init__(self, folder: Path, template: Template) -> None:
        self._folder, self._template = folder, template
        self._held = contextlib.ExitStack()
        self._rig: Rig | None = None
        self._number = 0

    def try_kind(self, kind: FaultKind, seed: int) -> Outcome:
        """Run one trial; where a rig breaks it is thrown away, the trial done again, once, and the first's story kept.

        A service that died though no one killed it is a result.
        """
        stories: list[str] = []
        for _ in range(ATTEMPTS):
            try:
                outcome = run_trial(self._rig_for(kind.plan), kind, seed)
            except Exception:  # noqa: BLE001 - whatever broke, the next trial has to go on
                stories.append(traceback.format_exc(limit=-3))
                has_died = self._rig is not None and not self._rig.is_alive
                self.clear()
                if has_died and Recovery.RESTARTED not in kind.recoveries:
                    return _failed(kind, seed, Trouble.SERVICE_DIED, stories)
            else:
                if outcome.is_red:
                    self.clear()
                return replace(outcome, note="\n".join([*stories, outcome.note]).strip())
        return _failed(kind, seed, Trouble.NO_RESULT, stories)

    def clear(self) -> None:
        self._rig = None
        self._held.close()
        self._held = contextlib.ExitStack()

    def _rig_for(self, plan: Plan) -> Rig:
        rig = self._rig
        if rig is not None and (rig.plan != plan or rig.worn_mb > WORN_MB):
            self.clear()
            rig = None
        if rig is None:
            self._number += 1
            rig = Rig(self._folder / str(self._number), plan, self._template)
            self._rig = self._held.enter_context(rig)
        return rig


def _failed(kind: FaultKind, seed: int, trouble: Trouble, stories: list[str]) -> Outcome:
    note = "\n".join(stories)
    return Outcome(kind=kind.code, seed=seed, off_ms=None, troubles=(trouble,), reported=(), recovery="", note=note)


def stamped(outcome: Outcome, revision: str) -> Outcome:
    return replace(outcome, revision=revision)
