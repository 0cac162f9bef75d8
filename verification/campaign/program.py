"""The command of a campaign: trials side by side, kept as they come, gone on with where it was stopped, then a report.

Exit code 0 where everything was as promised, 1 where something was not or is missing, 2 for a usage that is none.
"""

import argparse
import os
import platform
import signal
import sys
import tempfile
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import ClassVar, Generic

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from verification.campaign.bench import Bench, Kept, Trial
from verification.campaign.command_line import MOST_JOBS, WRONG_USAGE, bounded, revision_of_the_code
from verification.campaign.outcomes import OtherRevisionError, OutcomeFile, refuse_other_revision
from verification.campaign.workers import run

PIPED_WIDTH = 220


class Campaign(ABC, Generic[Trial, Kept]):
    """What one campaign is: its options, its trials, its benches, its report."""

    name: ClassVar[str]
    """Of its package in ``verification``."""
    kind: type[Kept]
    needs_root = False
    is_over_at_red = False
    """Whether the first red outcome ends it."""

    @abstractmethod
    def add_options(self, parser: argparse.ArgumentParser) -> None:
        """Add what this campaign can be asked."""

    @abstractmethod
    def trials(self, asked: argparse.Namespace) -> Sequence[Trial]:
        """Return all that was asked for; raise ValueError for what does not exist."""

    @abstractmethod
    def key_of(self, outcome: Kept) -> Hashable:
        """Return the trial of an outcome, as it is kept."""

    def key(self, trial: Trial) -> Hashable:
        """Return what names a trial."""
        return trial

    def is_done(self, outcome: Kept) -> bool:
        """Whether an outcome that is kept counts; else its trial is done again."""
        return True

    def turns(self, trials: Sequence[Trial]) -> list[Sequence[Trial]]:
        """Split what is left into what a worker does at one go."""
        return [[trial] for trial in trials]

    @abstractmethod
    def benches(
        self, asked: argparse.Namespace, folder: Path
    ) -> AbstractContextManager[Callable[[Path], Bench[Trial, Kept]]]:
        """Prepare what all benches share; give what makes one, which is sent to the workers."""

    @abstractmethod
    def label(self, outcome: Kept) -> str:
        """Name an outcome's trial for the progress bar."""

    @abstractmethod
    def report(self, console: Console, outcomes: Sequence[Kept], asked: argparse.Namespace) -> int:
        """Print what came of it, write it beside the outcomes; return the exit code."""

    def kept_in(self, folder: Path) -> OutcomeFile[Kept]:
        """Return the campaign's memory."""
        return OutcomeFile(folder / "outcomes.jsonl", self.kind, self.key_of)


def main(campaign: Campaign[Trial, Kept], about: str | None, arguments: list[str] | None = None) -> int:
    """Run a campaign's command; return its exit code."""
    asked = _parser(campaign, about).parse_args(arguments)
    console = Console(width=None if sys.stdout.isatty() else PIPED_WIDTH, highlight=False)
    try:
        trials, file, revision = campaign.trials(asked), campaign.kept_in(asked.out), revision_of_the_code()
        if not asked.keep:
            refuse_other_revision(file.read(), revision)
        if campaign.needs_root and os.geteuid() != 0:
            raise ValueError("a small disk cannot be mounted without root: nothing is run")  # noqa: TRY301
    except (ValueError, OtherRevisionError) as error:
        console.print(f"verification.{campaign.name}: {error}", style="red", markup=False)
        return WRONG_USAGE
    for number in (signal.SIGINT, signal.SIGTERM):  # the parent may have had them ignored
        signal.signal(number, signal.default_int_handler)
    _run(campaign, console, trials, file, asked, revision)
    wanted = {campaign.key(trial) for trial in trials}
    return campaign.report(console, [one for one in file.read() if campaign.key_of(one) in wanted], asked)


def left_of(campaign: Campaign[Trial, Kept], trials: Sequence[Trial], kept: Sequence[Kept]) -> list[Trial]:
    """Return what is not done yet."""
    done = {campaign.key_of(outcome) for outcome in kept if campaign.is_done(outcome)}
    return [trial for trial in trials if campaign.key(trial) not in done]


def source_of(command: str, outcomes: Sequence[Kept]) -> str:
    """Say where a table is from: the command, the state of the code, the machine."""
    revisions = ", ".join(sorted({outcome.revision for outcome in outcomes})) or "nothing"
    return f"`{command}` at {revisions}, {os.cpu_count()} processors, Python {platform.python_version()}"


def _run(
    campaign: Campaign[Trial, Kept],
    console: Console,
    trials: Sequence[Trial],
    file: OutcomeFile[Kept],
    asked: argparse.Namespace,
    revision: str,
) -> None:
    left = left_of(campaign, trials, file.read())
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with (
        tempfile.TemporaryDirectory(prefix=f"tidegate-{campaign.name}-") as place,
        Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console) as progress,
    ):
        task = progress.add_task(campaign.name, total=len(left))
        if not left:
            return
        with campaign.benches(asked, Path(place)) as make:
            for outcome in run(campaign.turns(left), make, Path(place), asked.jobs):
                file.append(replace(outcome, revision=revision))
                label = campaign.label(outcome)
                progress.update(task, advance=1, description=label)
                if outcome.is_red:
                    text = f"{label}: {', '.join(outcome.troubles)} {outcome.note}"
                    progress.console.print(text, style="red", markup=False)
                    if campaign.is_over_at_red and not asked.go_on:
                        return


def _parser(campaign: Campaign[Trial, Kept], about: str | None) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog=f"python -m verification.{campaign.name}", description=about)
    campaign.add_options(parser)
    parser.add_argument("--jobs", type=bounded(1, MOST_JOBS), default=2)
    parser.add_argument("--out", type=Path, default=Path("build") / campaign.name, help="folder of outcomes and report")
    parser.add_argument("--keep", action="store_true", help="go on with outcomes of another state of the code")
    if campaign.is_over_at_red:
        parser.add_argument("--go-on", action="store_true", help="do not end at the first red one")
    return parser
