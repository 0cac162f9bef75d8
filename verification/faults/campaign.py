"""The fault campaign: its trials are kinds of faults and seeds; kinds that need the same service share a rig."""

import argparse
import contextlib
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from verification.campaign.bench import Bench
from verification.campaign.command_line import bounded
from verification.campaign.program import Campaign, source_of
from verification.faults.document import write_document
from verification.faults.kinds import FaultKind, all_kinds, chosen
from verification.faults.plot import draw
from verification.faults.rig import WORN_MB, Rig, Template
from verification.faults.table import bound_text, duration_text, exit_code, markdown, rows, terminal_table, troubles
from verification.faults.template import learned
from verification.faults.trial import run_trial
from verification.faults.verdict import Outcome, Recovery, Trouble

MOST_SEEDS = 10_000
TRIALS_A_TURN = 10


class Trial(NamedTuple):
    """A kind of fault, by its code, at a random moment."""

    code: str
    seed: int


class FaultBench(Bench[Trial, Outcome]):
    """Breaks a service; one that died though no one killed it is a result."""

    def __init__(self, folder: Path, *, template: Template) -> None:
        super().__init__(folder)
        self._template = template
        self._kinds = {kind.code: kind for kind in all_kinds()}

    def do(self, trial: Trial) -> Outcome:
        """Do one trial, in a service that is set as its kind needs it."""
        kind, rig = self._kinds[trial.code], self._rig
        is_good = rig is not None and rig.plan == kind.plan and rig.worn_mb <= WORN_MB
        make = partial(Rig, plan=kind.plan, template=self._template)
        return run_trial(self.rig(make, is_good=is_good), kind, trial.seed)

    def broken(self, trial: Trial, *, is_last: bool) -> Outcome | None:
        """Say that the service died, or after the last attempt that there is no result."""
        has_died = self._rig is not None and not self._rig.is_alive
        if has_died and Recovery.RESTARTED not in self._kinds[trial.code].recoveries:
            return _failed(trial, Trouble.SERVICE_DIED)
        return _failed(trial, Trouble.NO_RESULT) if is_last else None


def _failed(trial: Trial, trouble: Trouble) -> Outcome:
    return Outcome(kind=trial.code, seed=trial.seed, off_ms=None, troubles=(trouble,), reported=(), recovery="")


class FaultCampaign(Campaign[Trial, Outcome]):
    """Every kind of fault, so many times."""

    name = "faults"
    kind = Outcome
    needs_root = True

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        """Add kinds and seeds."""
        parser.add_argument("--seeds", type=bounded(1, MOST_SEEDS), default=40)
        parser.add_argument("--first-seed", type=bounded(0, MOST_SEEDS), default=1)
        parser.add_argument("--kinds", default="", help="codes, comma-separated; all when left out")
        parser.add_argument("--write", action="store_true", help="put table and picture into docs/5-evidence/faults.md")

    def trials(self, asked: argparse.Namespace) -> list[Trial]:
        """Return every seed of every kind."""
        return [Trial(kind.code, seed) for kind in _kinds(asked) for seed in _seeds(asked)]

    def key_of(self, outcome: Outcome) -> Trial:
        """Return kind and seed."""
        return Trial(outcome.kind, outcome.seed)

    def turns(self, trials: Sequence[Trial]) -> list[Sequence[Trial]]:
        """Give a worker some seeds of a kind; kinds that need the same service lie side by side."""
        found: list[Sequence[Trial]] = []
        for kind in sorted(all_kinds(), key=lambda one: one.plan.name):
            own = [one for one in trials if one.code == kind.code]
            found += [own[at : at + TRIALS_A_TURN] for at in range(0, len(own), TRIALS_A_TURN)]
        return found

    @contextlib.contextmanager
    def benches(self, asked: argparse.Namespace, folder: Path) -> Iterator[Callable[[Path], FaultBench]]:
        """Learn the volunteer once for all."""
        yield partial(FaultBench, template=learned(folder / "template"))

    def label(self, outcome: Outcome) -> str:
        """Name kind and seed."""
        return f"{outcome.kind} seed {outcome.seed}"

    def report(self, console: Console, outcomes: Sequence[Outcome], asked: argparse.Namespace) -> int:
        """Print and write the table; 0 where every cell is as promised."""
        kinds, seeds = _kinds(asked), _seeds(asked)
        table = rows(kinds, outcomes, wanted=len(seeds))
        console.print(terminal_table(table))
        for line in troubles(table):
            console.print(line, style="red", markup=False)
        (asked.out / "table.md").write_text(markdown(table))
        draw(table, asked.out / "times.png")
        unsafe = sum(row.unsafe for row in table)
        bound = bound_text(unsafe, len(outcomes))
        if asked.write:
            first = f" (first seed {seeds[0]})" if seeds[0] != 1 else ""
            write_document(table, reported=source_of(f"make faults SEEDS={len(seeds)}{first}", outcomes) + bound)
        verdict = f"{len(outcomes)} faults of {len(kinds)} kinds: {unsafe} unsafe{bound}"
        console.print(verdict, style="red" if exit_code(table) else "green")
        console.print(duration_text(outcomes, asked.jobs))
        return exit_code(table)


def _kinds(asked: argparse.Namespace) -> tuple[FaultKind, ...]:
    return chosen(asked.kinds.split(",")) if asked.kinds else all_kinds()


def _seeds(asked: argparse.Namespace) -> range:
    return range(asked.first_seed, asked.first_seed + asked.seeds)
