"""``tidegate evaluate``: the tables and figures of the article, on virtual volunteers."""

import os
import signal
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table as RichTable

import engine
from engine.core.errors import InvalidValueError, TidegateError
from service.cli.cluster.options import (
    AuthorityFile,
    CertificateFile,
    KeyFile,
    SchedulerAddress,
    SchedulerOptions,
    scheduler_options,
)
from service.cli.terminal import refused, say

if TYPE_CHECKING:
    from lab.evaluation.runs.bench import DoAll, Progress as BenchProgress, Report
    from lab.evaluation.runs.datasets import Run
    from lab.evaluation.runs.marks import Mark
    from lab.evaluation.runs.scores import ScoredRun
    from lab.evaluation.table import Table

STOPPED = 130
PIPED_WIDTH = 220


def bench(
    context: typer.Context,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for index.html, results.json, a CSV file per table and a PNG file per figure."),
    ] = None,
    *,
    is_quick: Annotated[bool, typer.Option("--quick", help="Three datasets instead of fifteen.")] = False,
    is_accuracy: Annotated[
        bool, typer.Option("--accuracy", help="Only the recordings of both sensors that are measured whole.")
    ] = False,
    sensor: Annotated[
        str,
        typer.Option(
            help="With --accuracy: only this sensor; usual, locking, active-stereo or time-of-flight.",
            show_default=False,
        ),
    ] = "",
    jobs: Annotated[int | None, typer.Option(help="Number of processes; one per core by default.")] = None,
    seconds: Annotated[float, typer.Option(help="Length of each of the fifteen datasets [s].")] = 32.0,
    seed: Annotated[
        int, typer.Option(help="Seed of the recordings; the same seed gives the same ones on the same processor.")
    ] = 2017,
    work: Annotated[
        Path | None, typer.Option(help="Folder that keeps the recordings and measurements; OUT/work by default.")
    ] = None,
    is_strict: Annotated[bool, typer.Option("--strict", help="Exit code 1 when a required value is not met.")] = False,
    scheduler: SchedulerAddress = None,
    tls_ca: AuthorityFile = None,
    tls_cert: CertificateFile = None,
    tls_key: KeyFile = None,
) -> None:
    """Measure virtual volunteers as in the article, and print every table and figure of it with ours beside.

    Recordings and measurements that are complete are used again; an interrupted run goes on where it was. The full run
    keeps about six gigabytes of recordings. With laser, plane or spirometer: the instruments, on any recording.
    """
    if context.invoked_subcommand is not None:
        return
    if out is None:
        raise refused("evaluate", InvalidValueError("out", "", "a folder to write to (--out)"))
    try:
        cluster = scheduler_options(scheduler, tls_ca, tls_cert, tls_key)
        if cluster is not None and jobs is not None:
            raise InvalidValueError("jobs", jobs, "left out with --scheduler: its workers are counted there")
        plan_name = _plan_name(sensor, is_quick=is_quick, is_accuracy=is_accuracy)
        marks = _bench(
            out, work or out / "work", plan_name, jobs=jobs, seconds=seconds, seed=seed, sensor=sensor, cluster=cluster
        )
    except KeyboardInterrupt as stopped:
        say("tidegate evaluate: stopped; complete parts are kept, and the same command continues from there", "yellow")
        raise typer.Exit(STOPPED) from stopped
    except TidegateError as error:
        raise refused("evaluate", error) from error
    except OSError as error:
        raise refused("evaluate", f"{error.filename or out} cannot be written ({error.strerror or error})") from error
    missed = [mark for mark in marks if not mark.is_met]
    if missed and is_strict:
        raise typer.Exit(1)


def _plan_name(sensor: str, *, is_quick: bool, is_accuracy: bool) -> str:
    if sensor and not is_accuracy:
        raise InvalidValueError("sensor", sensor, "left out without --accuracy")
    if is_quick and is_accuracy:
        raise InvalidValueError("accuracy", "true", "left out with --quick")
    return "quick" if is_quick else "accuracy" if is_accuracy else "full"


def _bench(
    out: Path,
    work: Path,
    plan_name: str,
    *,
    jobs: int | None,
    seconds: float,
    seed: int,
    sensor: str,
    cluster: SchedulerOptions | None,
) -> "list[Mark]":
    from lab.evaluation.report.report import write_report
    from lab.evaluation.runs.bench import check_jobs
    from lab.evaluation.runs.datasets import accuracy_plan, check_plan, full_plan, quick_plan

    workers = len(os.sched_getaffinity(0)) if jobs is None else jobs
    check_jobs(workers)
    check_plan(seed, seconds)
    for folder, field in ((out, "out"), (work, "work")):
        if folder.exists() and not folder.is_dir():
            raise InvalidValueError(field, str(folder), "a folder")
    if plan_name == "accuracy":
        plan = accuracy_plan(seed, seconds, sensor)
    else:
        plan = {"quick": quick_plan, "full": full_plan}[plan_name](seed, seconds)
    scored = _with_bar(plan, work, workers, cluster)
    chosen = ("" if plan_name == "full" else f" --{plan_name}") + (f" --sensor {sensor}" if sensor else "")
    command = "tidegate evaluate --out OUT" + chosen + _changed(seconds, seed)
    tables, marks = write_report(
        scored,
        out,
        command=command,
        version=engine.__version__,
        seed=seed,
        settings={"plan": plan_name, "seconds": seconds, "recordings": len(plan)},
    )
    print_tables(tables)
    _conclude(marks, out)
    return marks


def _changed(seconds: float, seed: int) -> str:
    from lab.evaluation.runs.datasets import SECONDS, SEED

    return (f" --seconds {seconds:g}" if seconds != SECONDS else "") + (f" --seed {seed}" if seed != SEED else "")


def _with_bar(plan: "list[Run]", work: Path, jobs: int, cluster: SchedulerOptions | None) -> "list[ScoredRun]":
    """Run all datasets with one progress bar of generated and measured frames."""
    from lab.evaluation.runs.bench import run_bench

    before = signal.signal(signal.SIGTERM, _interrupt)
    bar = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    try:
        with bar:
            return run_bench(plan, work, jobs=jobs, report=_reporter(bar, plan), do_all=_elsewhere(cluster))
    finally:
        signal.signal(signal.SIGTERM, before)


def _elsewhere(cluster: SchedulerOptions | None) -> "DoAll | None":
    if cluster is None:
        return None
    from lab.commands.evaluate.on_cluster import evaluate_on_cluster

    return partial(evaluate_on_cluster, cluster)


def _reporter(bar: Progress, plan: "list[Run]") -> "Report":
    task = bar.add_task("starting", total=sum(2 * run.frames for run in plan))
    done = {run.name: 0 for run in plan}
    doing: dict[str, str] = {}

    def report(progress: "BenchProgress") -> None:
        done[progress.run] = progress.frames_done
        doing.pop(progress.run, None)
        if progress.doing != "done":
            doing[progress.run] = f"{progress.doing} {progress.run}"
        bar.update(task, completed=sum(done.values()), description=", ".join(doing.values()) or "judging")

    return report


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    """Handle SIGTERM like Ctrl-C: no file is left incomplete."""
    raise KeyboardInterrupt


def rich_table(table: "Table") -> RichTable:
    """Print a table; rows with a required value that is not met are red."""
    shown = RichTable(title=escape(table.title), title_justify="left", caption=escape(table.note) or None)
    shown.caption_justify = "left"
    for number, column in enumerate(table.columns):
        shown.add_column(escape(column), justify="left" if number == 0 else "right", overflow="fold")
    for number, row in enumerate(table.rows):
        style = "red" if number in table.failed else None
        shown.add_row(*(escape(table.text(cell)) for cell in row), style=style)
    return shown


def print_tables(tables: "Iterable[Table]", width: int = PIPED_WIDTH) -> None:
    """Print tables below each other, ``width`` characters wide where the output is no terminal."""
    console = Console()
    console = console if console.is_terminal else Console(width=width)
    for table in tables:
        console.print(rich_table(table), "")


def _conclude(marks: "list[Mark]", out: Path) -> None:
    missed = [mark.name for mark in marks if not mark.is_met]
    if missed:
        say(f"{len(missed)} of {len(marks)} required values not met: {'; '.join(missed)}", "red")
    else:
        say(f"All {len(marks)} required values met", "green")
    say(f"Written to {out}: open {out / 'index.html'}")
