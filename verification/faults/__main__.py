"""The fault campaign: ``python -m verification.faults --seeds 40 --jobs 2 --out DIR``.

Exit code 0 when every trial was safe, reported and recovered; 1 when one was not, or is missing; 2 for a usage
that is none. A campaign that was stopped goes on where it was, with the same folder.
"""

import argparse
import os
import platform
import sys
from pathlib import Path

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from verification.faults.campaign import kept_in, run, stamped, turns
from verification.faults.command_line import MOST_JOBS, WRONG_USAGE, bounded, revision_of_the_code
from verification.faults.document import write_document
from verification.faults.kinds import FaultKind, all_kinds, chosen
from verification.faults.outcomes import OtherRevisionError, OutcomeFile, refuse_other_revision
from verification.faults.plot import draw
from verification.faults.table import exit_code, markdown, rows, terminal_table, troubles
from verification.faults.verdict import Outcome

MOST_SEEDS = 10_000
LONG_SEEDS = 40
"""Seeds of a whole campaign, for which the duration is said."""


def main(arguments: list[str] | None = None) -> int:
    asked = _parser().parse_args(arguments)
    console = Console(width=None if sys.stdout.isatty() else 220, highlight=False)
    try:
        kinds = chosen(asked.kinds.split(",")) if asked.kinds else all_kinds()
        revision = revision_of_the_code()
        file = kept_in(asked.out)
        if not asked.keep:
            refuse_other_revision(file.read(), revision)
    except (ValueError, OtherRevisionError) as error:
        console.print(f"verification.faults: {error}", style="red", markup=False)
        return WRONG_USAGE
    seeds = range(asked.first_seed, asked.first_seed + asked.seeds)
    if os.geteuid() != 0:
        console.print("verification.faults: a small disk cannot be mounted without root: nothing is run", style="red")
        return WRONG_USAGE
    _run(console, file, kinds, seeds, jobs=asked.jobs, revision=revision)
    return _report(console, file, kinds, seeds, asked.out, jobs=asked.jobs, writes=asked.write)


def _run(
    console: Console,
    file: OutcomeFile[Outcome],
    kinds: tuple[FaultKind, ...],
    seeds: range,
    *,
    jobs: int,
    revision: str,
) -> None:
    done = {(outcome.kind, outcome.seed) for outcome in file.read()}
    work = turns(kinds, seeds, done)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task("faults", total=sum(len(turn.seeds) for turn in work))
        for outcome in run(work, jobs):
            file.append(stamped(outcome, revision))
            progress.update(task, advance=1, description=outcome.kind)
            if outcome.is_red:
                progress.console.print(
                    f"{outcome.kind} seed {outcome.seed}: {', '.join(outcome.troubles)} {outcome.note}",
                    style="red",
                    markup=False,
                )


def _report(
    console: Console,
    file: OutcomeFile[Outcome],
    kinds: tuple[FaultKind, ...],
    seeds: range,
    out: Path,
    *,
    jobs: int,
    writes: bool,
) -> int:
    outcomes = [outcome for outcome in file.read() if outcome.seed in seeds]
    table = rows(kinds, outcomes, wanted=len(seeds))
    console.print(terminal_table(table))
    for line in troubles(table):
        console.print(line, style="red", markup=False)
    (out / "table.md").write_text(markdown(table))
    draw(table, out / "times.png")
    if writes:
        write_document(table, reported=_how(outcomes, seeds))
    unsafe = sum(row.unsafe for row in table)
    verdict = f"{len(outcomes)} faults of {len(kinds)} kinds: {unsafe} unsafe{bound_text(unsafe, len(outcomes))}"
    console.print(verdict, style="red" if exit_code(table) else "green")
    console.print(duration_text(outcomes, jobs))
    return exit_code(table)


def bound_text(unsafe: int, trials: int) -> str:
    """Say how many unsafe ones could still be among as many faults as these: the rule of three."""
    return f", 0 of {trials}: below {100.0 * 3.0 / trials:.2g} % at 95 %" if unsafe == 0 and trials > 0 else ""


def duration_text(outcomes: list[Outcome], jobs: int) -> str:
    """Say how long the trials took, and `LONG_SEEDS` seeds would take here."""
    kinds = {outcome.kind for outcome in outcomes}
    if not outcomes:
        return "no trial"
    each_s = sum(outcome.seconds for outcome in outcomes) / len(outcomes)
    hours = each_s * LONG_SEEDS * len(kinds) / jobs / 3600.0
    return f"{each_s:.1f} s a trial: {LONG_SEEDS} seeds of these {len(kinds)} kinds take {hours:.1f} h with {jobs} jobs"


def _how(outcomes: list[Outcome], seeds: range) -> str:
    """Say where the table is from: the command, the state of the code, the machine."""
    revisions = ", ".join(sorted({outcome.revision for outcome in outcomes})) or "nothing"
    unsafe = sum(outcome.is_unsafe for outcome in outcomes)
    command = f"make faults SEEDS={len(seeds)}" + (f" (first seed {seeds[0]})" if seeds[0] != 1 else "")
    machine = f"{os.cpu_count()} processors, Python {platform.python_version()}"
    return f"`{command}` at {revisions}, {machine}{bound_text(unsafe, len(outcomes))}"


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m verification.faults", description=__doc__)
    parser.add_argument("--seeds", type=bounded(1, MOST_SEEDS), default=40)
    parser.add_argument("--first-seed", type=bounded(0, MOST_SEEDS), default=1)
    parser.add_argument("--jobs", type=bounded(1, MOST_JOBS), default=2)
    parser.add_argument("--out", type=Path, required=True, help="folder for outcomes, table and picture")
    parser.add_argument("--kinds", default="", help="codes, comma-separated; all when left out")
    parser.add_argument("--keep", action="store_true", help="go on with outcomes of another state of the code")
    parser.add_argument(
        "--write", action="store_true", help="put the table and the picture into docs/5-evidence/faults.md"
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
