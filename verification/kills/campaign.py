"""The kill campaign: its trials are numbers, of which each and the seed say the moment of the kill."""

import argparse
import contextlib
import json
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rich.console import Console
from sqlalchemy import URL

from tests.support.database.postgres import PostgresServer
from verification.campaign.bench import Bench
from verification.campaign.command_line import bounded
from verification.campaign.program import Campaign, source_of
from verification.faults.rig import WORN_MB, Template
from verification.faults.template import learned
from verification.kills.document import write_document
from verification.kills.moments import MOMENTS, moment_of
from verification.kills.rig import KillRig
from verification.kills.table import draw, markdown, summary, terminal_table
from verification.kills.trial import run_trial
from verification.kills.verdict import Outcome, Trouble

POSTGRESQL = "postgresql"
STARTING = "starting"
MOST_KILLS, MOST_SEED = 100_000, 10**9


class Kill(NamedTuple):
    """A kill: number and seed say the moment, unless its code is given."""

    number: int
    seed: int
    code: str | None = None


class KillBench(Bench[Kill, Outcome]):
    """Kills a service, on SQLite or on PostgreSQL."""

    def __init__(self, folder: Path, *, template: Template, is_postgresql: bool = False) -> None:
        super().__init__(folder)
        self._template = template
        self._server = PostgresServer() if is_postgresql else None

    def do(self, trial: Kill) -> Outcome:
        """Do one kill."""
        moment = moment_of(*trial)
        if moment.is_fresh and self._server is not None:  # the first start of all is SQLite's: it makes the file
            moment = moment_of(trial.number, trial.seed, STARTING)
        is_good = self._rig is not None and self._rig.worn_mb <= WORN_MB
        return run_trial(self.rig(self._made, is_good=is_good), moment, trial.number, trial.seed)

    def broken(self, trial: Kill, *, is_last: bool) -> Outcome | None:
        """Say after the last attempt that there is no result."""
        if not is_last:
            return None
        return Outcome(number=trial.number, moment=moment_of(*trial).code, troubles=(Trouble.NO_RESULT,))

    def end(self) -> None:
        """Let go of everything, the server too."""
        super().end()
        if self._server is not None:
            self._server.close()

    def _made(self, folder: Path) -> KillRig:
        return KillRig(folder, self._template, None if self._server is None else _plain(self._server.empty()))


def _plain(url: URL) -> str:
    return url.set(drivername="postgresql").render_as_string(hide_password=False)


class KillCampaign(Campaign[Kill, Outcome]):
    """So many kills at the moments of a seed; the first red one ends it."""

    name = "kills"
    kind = Outcome
    needs_root = True
    is_over_at_red = True

    def add_options(self, parser: argparse.ArgumentParser) -> None:
        """Add how many, of which seed, on which database."""
        parser.add_argument("--moments", type=bounded(1, MOST_KILLS), default=200, help="how many kills")
        parser.add_argument("--seed", type=bounded(0, MOST_SEED), default=1)
        parser.add_argument("--database", choices=["sqlite", POSTGRESQL], default="sqlite")
        parser.add_argument("--moment", choices=[moment.code for moment in MOMENTS], help="this one alone")
        parser.add_argument("--write", action="store_true", help="put table and picture into docs/5-evidence/kills.md")

    def trials(self, asked: argparse.Namespace) -> list[Kill]:
        """Return the kills."""
        return [Kill(number, asked.seed, asked.moment) for number in range(asked.moments)]

    def key(self, trial: Kill) -> int:
        """Return the number."""
        return trial.number

    def key_of(self, outcome: Outcome) -> int:
        """Return the number."""
        return outcome.number

    def is_done(self, outcome: Outcome) -> bool:
        """A kill without a result is done again."""
        return outcome.troubles != (Trouble.NO_RESULT,)

    @contextlib.contextmanager
    def benches(self, asked: argparse.Namespace, folder: Path) -> Iterator[Callable[[Path], KillBench]]:
        """Learn the volunteer once for all."""
        is_postgresql = asked.database == POSTGRESQL
        yield partial(KillBench, template=learned(folder / "template"), is_postgresql=is_postgresql)

    def label(self, outcome: Outcome) -> str:
        """Name the moment and the number."""
        return f"{outcome.moment} number {outcome.number}"

    def report(self, console: Console, outcomes: Sequence[Outcome], asked: argparse.Namespace) -> int:
        """Print and write the table; 0 where no kill is red or missing."""
        if not outcomes:
            return 1
        kept = sorted(outcomes, key=lambda outcome: outcome.number)
        console.print(terminal_table(kept))
        found = summary(kept)
        console.print(", ".join(f"{name} {value}" for name, value in found.items()))
        (asked.out / "table.md").write_text(markdown(kept))
        (asked.out / "summary.json").write_text(json.dumps(found, indent=1) + "\n")
        draw(kept, asked.out / "kills.png")
        if asked.write:
            other = "" if asked.database != POSTGRESQL else f" DATABASE={POSTGRESQL}"
            write_document(
                kept, reported=source_of(f"make kills MOMENTS={asked.moments} SEED={asked.seed}{other}", kept)
            )
        is_green = len(kept) == asked.moments and not any(outcome.is_red for outcome in kept)
        console.print(f"{len(kept)} of {asked.moments} kills, {found['red']} red", style="green" if is_green else "red")
        return 0 if is_green else 1
