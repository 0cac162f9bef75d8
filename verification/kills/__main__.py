"""The kill campaign: ``python -m verification.kills --moments 200 --jobs 2 --seed 1 --out DIR``.

Exit code 0 when every kill left everything as promised; 1 at the first that did not; 2 for a usage that is none. A
campaign that was stopped goes on where it was, with the same folder and seed.
"""

import argparse
import json
import os
import platform
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from verification.faults.campaign import stamped
from verification.faults.command_line import MOST_JOBS, WRONG_USAGE, bounded, revision_of_the_code
from verification.faults.outcomes import OtherRevisionError, OutcomeFile, refuse_other_revision
from verification.kills.campaign import kept_in, run
from verification.kills.document import write_document
from verification.kills.moments import MOMENTS
from verification.kills.table import draw, markdown, summary, terminal_table
from verification.kills.verdict import Outcome, Trouble

POSTGRESQL = "postgresql"
MOST_KILLS, MOST_SEED = 100_000, 10**9


def main(arguments: list[str] | None = None) -> int:
    asked = _parser().parse_args(arguments)
    console = Console(width=None if sys.stdout.isatty() else 200, highlight=False)
    file, revision = kept_in(asked.out), revision_of_the_code()
    try:
        if not asked.keep:
            refuse_other_revision(file.read(), revision)
    except OtherRevisionError as error:
        console.print(f"verification.kills: {error}", style="red", markup=False)
        return WRONG_USAGE
    if os.geteuid() != 0:
        console.print("verification.kills: a small disk cannot be mounted without root: nothing is run", style="red")
        return WRONG_USAGE
    for number in (signal.SIGINT, signal.SIGTERM):  # the parent may have had them ignored
        signal.signal(number, signal.default_int_handler)
    _run(console, file, asked, revision)
    return _report(console, file, asked)


def _run(console: Console, file: OutcomeFile[Outcome], asked: argparse.Namespace, revision: str) -> None:
    done = {outcome.number for outcome in file.read() if outcome.troubles != (Trouble.NO_RESULT,)}
    numbers = [number for number in range(asked.moments) if number not in done]
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn())
    with Progress(*columns, TimeElapsedColumn(), TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task("kills", total=len(numbers))
        for outcome in run(
            numbers, seed=asked.seed, jobs=asked.jobs, code=asked.moment, is_postgresql=asked.database == POSTGRESQL
        ):
            file.append(stamped(outcome, revision))
            progress.update(task, advance=1, description=outcome.moment)
            if outcome.is_red:
                reported = f"{outcome.moment} number {outcome.number}: {', '.join(outcome.troubles)} {outcome.note}"
                progress.console.print(reported, style="red", markup=False)
                if not asked.go_on:
                    return


def _report(console: Console, file: OutcomeFile[Outcome], asked: argparse.Namespace) -> int:
    kept = sorted(file.read(), key=lambda outcome: outcome.number)
    outcomes = [outcome for outcome in kept if outcome.number < asked.moments]
    if not outcomes:
        return 1
    console.print(terminal_table(outcomes))
    found = summary(outcomes)
    console.print(", ".join(f"{name} {value}" for name, value in found.items()))
    (asked.out / "table.md").write_text(markdown(outcomes))
    (asked.out / "summary.json").write_text(json.dumps(found, indent=1) + "\n")
    draw(outcomes, asked.out / "kills.png")
    if asked.write:
        write_document(outcomes, reported=_how(outcomes, asked))
    is_whole = len(outcomes) == asked.moments
    is_green = is_whole and not any(outcome.is_red for outcome in outcomes)
    console.print(f"{len(outcomes)} of {asked.moments} kills, {found['red']} red", style="green" if is_green else "red")
    return 0 if is_green else 1


def _how(outcomes: Sequence[Outcome], asked: argparse.Namespace) -> str:
    revisions = ", ".join(sorted({outcome.revision for outcome in outcomes}))
    other = "" if asked.database != POSTGRESQL else f" DATABASE={POSTGRESQL}"
    command = f"make kills MOMENTS={asked.moments} SEED={asked.seed}{other}"
    return f"`{command}` at {revisions}, {os.cpu_count()} processors, Python {platform.python_version()}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m verification.kills", description=__doc__)
    parser.add_argument("--moments", type=bounded(1, MOST_KILLS), default=200, help="how many kills")
    parser.add_argument("--seed", type=bounded(0, MOST_SEED), default=1)
    parser.add_argument("--jobs", type=bounded(1, MOST_JOBS), default=2)
    parser.add_argument("--out", type=Path, required=True, help="folder for outcomes, table and picture")
    parser.add_argument("--database", choices=["sqlite", POSTGRESQL], default="sqlite")
    parser.add_argument("--moment", choices=[moment.code for moment in MOMENTS], help="this one alone")
    parser.add_argument("--go-on", action="store_true", help="do not end at the first red kill")
    parser.add_argument("--keep", action="store_true", help="go on with outcomes of another state of the code")
    parser.add_argument(
        "--write", action="store_true", help="put the table and the picture into docs/5-evidence/kills.md"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
