"""``tidegate evaluate breathing``: accuracy of the breathing monitor on synthetic and recorded breathing.

``tidegate evaluate gate``: delays of the beam edges, and what the rules on breathing hold.
"""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engine.core.errors import InvalidValueError, TidegateError
from engine.core.files import write_whole
from lab.commands.evaluate.bench import STOPPED, print_tables
from service.cli.terminal import frame_bar, refused, say

if TYPE_CHECKING:
    from lab.evaluation.breathing.recorded import MonitoredTrace, RpmConventions
    from lab.evaluation.table import Table
from functools import partial
from typing import TYPE_CHECKING

from service.cli.terminal import advance

if TYPE_CHECKING:
    from lab.evaluation.table import Table


MAX_TRACES = 100


def breathing(
    out: Annotated[Path, typer.Option(help="Folder for a CSV file per table and a PNG file per trace.")],
    trace: Annotated[
        list[Path] | None,
        typer.Option(help="Breathing trace: a marker CSV, an RPM .vxp or a QA text file; repeatable."),
    ] = None,
    seeds: Annotated[
        int, typer.Option(help="Synthetic signals per volunteer (ten), event and drift; 0 for none.")
    ] = 10,
    hours: Annotated[
        float, typer.Option(help="Total duration of regular breathing for the rate of false alarms [h].")
    ] = 6.0,
    jobs: Annotated[int | None, typer.Option(help="Number of processes; one per core by default.")] = None,
    rpm_flag: Annotated[int, typer.Option(help="Value of the RPM flag for a breath that is not periodic.")] = -2,
    rpm_zero: Annotated[str, typer.Option(help="Zero of the RPM phase: end of inhale or exhale.")] = "inhale",
) -> None:
    """Run the breathing monitor on synthetic breathing with labelled events and on recorded traces.

    Writes the tables as CSV and a picture of each recorded trace with phase, baseline and events.
    """
    from lab.evaluation.breathing.bench import check_plan
    from lab.evaluation.breathing.recorded import RpmConventions

    try:
        if out.exists() and not out.is_dir():
            raise InvalidValueError("out", str(out), "a folder")
        traces = trace or []
        if len(traces) > MAX_TRACES:
            raise InvalidValueError("trace", len(traces), f"at most {MAX_TRACES} traces")
        workers = len(os.sched_getaffinity(0)) if jobs is None else jobs
        check_plan(seeds, hours, workers)
        recorded = _monitor(traces, RpmConventions(not_periodic=rpm_flag, zero=rpm_zero))
        tables = [*_bench(seeds, hours, workers), *_recorded_tables(recorded)]
        out.mkdir(parents=True, exist_ok=True)
        for table in tables:
            write_whole(out / f"{table.name}.csv", table.to_csv().encode())
        _draw(recorded, out)
    except KeyboardInterrupt as stopped:
        say("tidegate evaluate breathing: stopped; nothing is written", "yellow")
        raise typer.Exit(STOPPED) from stopped
    except TidegateError as error:
        raise refused("evaluate breathing", error) from error
    except OSError as error:
        raise refused("evaluate breathing", f"{out} cannot be written ({error.strerror or error})") from error
    print_tables(tables)
    say(f"Written to {out}")


def _bench(seeds: int, hours: float, jobs: int) -> "list[Table]":
    from lab.evaluation.breathing.bench import plan, run
    from lab.evaluation.breathing.tables import tables_of

    planned = plan(seeds, hours)
    if not planned:
        return []
    with frame_bar() as bar:
        task = bar.add_task("made breathing", total=len(planned))
        return tables_of(run(planned, jobs, lambda done: bar.update(task, completed=done)))


def _monitor(traces: list[Path], conventions: "RpmConventions") -> "list[MonitoredTrace]":
    from lab.evaluation.breathing.recorded import monitor_trace

    with frame_bar() as bar:
        task = bar.add_task("recorded breathing", total=len(traces))
        recorded = []
        for number, path in enumerate(traces):
            recorded.append(monitor_trace(path, conventions))
            bar.update(task, completed=number + 1)
    return recorded


def _recorded_tables(recorded: "list[MonitoredTrace]") -> "list[Table]":
    from lab.evaluation.breathing.tables import agreement, recorded_events, recorded_shares

    if not recorded:
        return []
    rpm = agreement(recorded)
    return [recorded_shares(recorded), recorded_events(recorded), *([] if rpm is None else [rpm])]


def _draw(recorded: "list[MonitoredTrace]", out: Path) -> None:
    from lab.evaluation.breathing.tables import draw_breathing

    for number, one in enumerate(recorded):
        picture = draw_breathing(one.name, one.time_s, one.value_mm, one.output)
        # Two folders may hold files of one name.
        is_twice = any(other.name == one.name for other in recorded[:number])
        name = f"{one.name}.{number}" if is_twice else one.name
        write_whole(out / f"{name}.png", picture.png)


def gate(
    out: Annotated[Path, typer.Option(help="Folder for a CSV file per table.")],
    work: Annotated[Path | None, typer.Option(help="Folder that keeps the recordings; OUT/work by default.")] = None,
    seconds: Annotated[float, typer.Option(help="Length of each recording [s].")] = 60.0,
    seed: Annotated[
        int, typer.Option(help="Seed of the recordings; the same seed gives the same ones on the same processor.")
    ] = 2017,
    trace: Annotated[
        list[Path] | None,
        typer.Option(
            help="Breathing trace on which the rules on breathing are evaluated too: a marker CSV, an RPM .vxp or a QA "
            "text file; repeatable."
        ),
    ] = None,
    volunteer: Annotated[
        list[int] | None,
        typer.Option(help="Virtual volunteer of the made courses, 1 to 10; repeatable. Five by default."),
    ] = None,
    *,
    is_rules_only: Annotated[bool, typer.Option("--rules-only", help="Leave out the delays of the edges.")] = False,
    is_edges_only: Annotated[bool, typer.Option("--edges-only", help="Leave out the rules on breathing.")] = False,
    is_strict: Annotated[
        bool,
        typer.Option("--strict", help="Exit code 1 when an edge is later than allowed, or rules hold too much."),
    ] = False,
) -> None:
    """Gate five virtual volunteers with windows of every kind and compare each edge with that of the true motion.

    Then evaluate the rules on breathing (drift, ceased breathing, longest beam-on), on made courses and on recorded
    traces.
    """
    from lab.evaluation.runs.datasets import check_plan

    try:
        check_plan(seed, seconds)
        _check(out, work, seconds, trace or [])
        _check_parts(is_edges_only=is_edges_only, needs_rules=is_rules_only or bool(trace) or bool(volunteer))
        tables = [] if is_rules_only else [_edge_table(work or out / "work", seed, seconds)]
        tables += [] if is_edges_only else _rule_tables(trace or [], volunteer)
        out.mkdir(parents=True, exist_ok=True)
        for table in tables:
            write_whole(out / f"{table.name}.csv", table.to_csv().encode())
    except TidegateError as error:
        raise refused("evaluate gate", error) from error
    except OSError as error:
        raise refused("evaluate gate", f"{out} cannot be written ({error.strerror or error})") from error
    print_tables(tables)
    say(f"Written to {', '.join(str(out / f'{table.name}.csv') for table in tables)}")
    if is_strict and any(table.failed for table in tables):
        raise typer.Exit(1)


def _check(out: Path, work: Path | None, seconds: float, traces: list[Path]) -> None:
    if not seconds >= 40.0:
        raise InvalidValueError("seconds", seconds, "at least 40: a breath hold comes after 20 s of free breathing")
    if len(traces) > MAX_TRACES:
        raise InvalidValueError("trace", len(traces), f"at most {MAX_TRACES} traces")
    for folder, field in ((out, "out"), (work, "work")):
        if folder is not None and folder.exists() and not folder.is_dir():
            raise InvalidValueError(field, str(folder), "a folder")


def _check_parts(*, is_edges_only: bool, needs_rules: bool) -> None:
    if is_edges_only and needs_rules:
        raise InvalidValueError("edges-only", "given", "without --rules-only, --trace and --volunteer")


def _edge_table(work: Path, seed: int, seconds: float) -> "Table":
    from lab.evaluation.gating.tables import gate_table
    from lab.evaluation.gating.timing import EdgeTiming, plan, time_gate

    runs = plan(seed, seconds)
    timings: list[EdgeTiming] = []
    with frame_bar() as bar:
        for run in runs:
            task = bar.add_task(f"{run.name}, {run.scenario}", total=2 * run.frames)
            timings += time_gate(run, work / run.name, partial(advance, bar, task))
    return gate_table(timings, runs[0].fps)


def _rule_tables(traces: list[Path], volunteers: list[int] | None) -> "list[Table]":
    from lab.evaluation.gating.breathing_rules import (
        TRIALS_EACH,
        VOLUNTEERS,
        WINDOWS,
        gate_trace,
        stopped_trials,
    )
    from lab.evaluation.gating.tables import recorded_table, stopped_table

    chosen = tuple(volunteers or VOLUNTEERS)
    recorded, trials = [], []
    with frame_bar() as bar:
        task = bar.add_task("rules on breathing, recorded courses", total=len(WINDOWS) * len(traces))
        for number, window in enumerate(WINDOWS if traces else ()):
            courses = []
            for done, path in enumerate(traces, start=1):
                courses += gate_trace(path, window)
                bar.update(task, completed=number * len(traces) + done)
            recorded.append(recorded_table(window, courses))
        task = bar.add_task("rules on breathing, made courses", total=TRIALS_EACH * len(chosen))
        for trial in stopped_trials(chosen):
            trials.append(trial)
            bar.update(task, completed=len(trials))
    return [stopped_table(trials), *recorded]
