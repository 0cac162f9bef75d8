"""``tidegate evaluate breathing``: accuracy of the breathing monitor on synthetic and recorded breathing."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from engine.core.errors import InvalidValueError, TidegateError
from engine.core.files import write_whole
from service.cli.evaluate.bench import STOPPED, print_tables
from service.cli.terminal import frame_bar, refused, say

if TYPE_CHECKING:
    from engine.lab.evaluation.breathing.recorded import MonitoredTrace, RpmConventions
    from engine.lab.evaluation.table import Table

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
    from engine.lab.evaluation.breathing.bench import check_plan
    from engine.lab.evaluation.breathing.recorded import RpmConventions

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
    from engine.lab.evaluation.breathing.bench import plan, run
    from engine.lab.evaluation.breathing.tables import tables_of

    planned = plan(seeds, hours)
    if not planned:
        return []
    with frame_bar() as bar:
        task = bar.add_task("made breathing", total=len(planned))
        return tables_of(run(planned, jobs, lambda done: bar.update(task, completed=done)))


def _monitor(traces: list[Path], conventions: "RpmConventions") -> "list[MonitoredTrace]":
    from engine.lab.evaluation.breathing.recorded import monitor_trace

    with frame_bar() as bar:
        task = bar.add_task("recorded breathing", total=len(traces))
        recorded = []
        for number, path in enumerate(traces):
            recorded.append(monitor_trace(path, conventions))
            bar.update(task, completed=number + 1)
    return recorded


def _recorded_tables(recorded: "list[MonitoredTrace]") -> "list[Table]":
    from engine.lab.evaluation.breathing.tables import agreement, recorded_events, recorded_shares

    if not recorded:
        return []
    rpm = agreement(recorded)
    return [recorded_shares(recorded), recorded_events(recorded), *([] if rpm is None else [rpm])]


def _draw(recorded: "list[MonitoredTrace]", out: Path) -> None:
    from engine.lab.evaluation.breathing.pictures import draw_breathing

    for number, one in enumerate(recorded):
        picture = draw_breathing(one.name, one.time_s, one.value_mm, one.output)
        # Two folders may hold files of one name.
        is_twice = any(other.name == one.name for other in recorded[:number])
        name = f"{one.name}.{number}" if is_twice else one.name
        write_whole(out / f"{name}.png", picture.png)
