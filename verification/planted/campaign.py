"""The campaign of planted faults: its trials are the rows of the table."""

import argparse
import contextlib
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from verification.campaign.bench import Bench
from verification.campaign.outcomes import TrialOutcome
from verification.campaign.program import Campaign
from verification.planted.planted import PLANTED, Planted, copied, outcome_of

FAILS = "fails"


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome(TrialOutcome):
    """What the test of one broken mechanism did."""

    what: str


class PlantedBench(Bench[Planted, Outcome]):
    """A copy of the sources."""

    def do(self, trial: Planted) -> Outcome:
        """Break one mechanism and run its test."""
        began_s = time.monotonic()
        found = outcome_of(trial, self.rig(_copy, is_good=True))
        troubles = () if found == FAILS else (f"{found}: {trial.file}; {trial.test}",)
        return Outcome(what=trial.what, troubles=troubles, seconds=time.monotonic() - began_s)

    def broken(self, trial: Planted, *, is_last: bool) -> Outcome | None:
        """Say after the last attempt that the test did not run."""
        return Outcome(what=trial.what, troubles=(f"not run: {trial.file}; {trial.test}",)) if is_last else None


@contextlib.contextmanager
def _copy(folder: Path) -> Iterator[Path]:
    folder.mkdir(parents=True)
    yield copied(folder)


class PlantedCampaign(Campaign[Planted, Outcome]):
    """Every row of the table."""

    name = "planted"
    kind = Outcome

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        """Add a part of a description."""
        parser.add_argument("--only", default="", help="those whose description has these words")

    def trials(self, asked: argparse.Namespace) -> list[Planted]:
        """Return the rows of the table; raise ValueError where none has the words."""
        found = [one for one in PLANTED if asked.only in one.what]
        if not found:
            raise ValueError(f"no description has {asked.only!r}")
        return found

    def key(self, trial: Planted) -> str:
        """Return the description."""
        return trial.what

    def key_of(self, outcome: Outcome) -> str:
        """Return the description."""
        return outcome.what

    @contextlib.contextmanager
    def benches(self, asked: argparse.Namespace, folder: Path) -> Iterator[Callable[[Path], PlantedBench]]:
        """Each bench copies the sources."""
        yield PlantedBench

    def label(self, outcome: Outcome) -> str:
        """Return the description."""
        return outcome.what

    def report(self, console: Console, outcomes: Sequence[Outcome], asked: argparse.Namespace) -> int:
        """Print how many tests fail; 0 where all do."""
        wanted = len(self.trials(asked))
        failing = sum(not outcome.is_red for outcome in outcomes)
        console.print(f"{failing} of {wanted} tests fail without their mechanism")
        return int(failing < wanted)
