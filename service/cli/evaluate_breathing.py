"""``tidegate evaluate breathing``: what the breathing monitor finds, and what it makes of recorded breathing."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from engine.errors import InvalidValueError, TidegateError
from service.cli.evaluate_bench import PIPED_WIDTH, STOPPED, rich_table
from service.cli.terminal import frame_bar, refused, say
from service.cli.written import write_whole

if TYPE_CHECKING:
    from engine.evaluation.breath_recorded import Recorded, RpmSense
    from engine.evaluation.tables import Table

MAX_TRACES = 100


def breathing(
    out: Annotated[Path, typer.Option(help="Folder for a CSV a table and a PNG a trace.")],
    trace: Annotated[
        list[Path] | None,
        typer.Option(help="Recorded breathing: a marker CSV, an RPM .vxp or a QA text; as often as wanted."),
    ] = None,
    seeds: Annotated[
        int, typer.Option(help="Made signals for each of ten volunteers, event and drift; 0 for none.")
    ] = 10,
    hours: Annotated[float, typer.Option(help="Regular breathing in all, for the false alarms [h].")] = 6.0,
    jobs: Annotated[int | None, typer.Option(help="Processes; one a processor when not given.")] = None,
    rpm_flag: Annotated[int, typer.Option(help="The flag by which an RPM says that a breath is not periodic.")] = -2,
    rpm_zero: Annotated[
        str, typer.Option(help="Where an RPM's phase is 0: at the end of inhale or exhale.")
    ] = "inhale",
) -> None:
    """Follow made breathing with labelled events, and recorded breathing; print what was found and what was missed.

    Writes the tables as CSV and a picture of each recorded trace with phase, baseline and events.
    """
    from engine.evaluation.breath_bench import check_plan
    from engine.evaluation.breath_recorded import RpmSense

    try:
        if out.exists() and not out.is_dir():
            raise InvalidValueError("out", str(out), "a folder")
        traces = trace or []
        if len(traces) > MAX_TRACES:
            raise InvalidValueError("trace", len(traces), f"at most {MAX_TRACES} traces")
        workers = len(os.sched_getaffinity(0)) if jobs is None else jobs
        check_plan(seeds, hours, workers)
        recorded = _listen(traces, RpmSense(not_periodic=rpm_flag, zero=rpm_zero))
        tables = [*_bench(seeds, hours, workers), *_recorded_tables(recorded)]
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
    console = Console()
    console = console if console.is_terminal else Console(width=PIPED_WIDTH)
    for shown in tables:
        console.print(rich_table(shown), "")
    say(f"Written to {out}")


def _bench(seeds: int, hours: float, jobs: int) -> "list[Table]":
    from engine.evaluation.breath_bench import plan, run
    from engine.evaluation.breath_tables import tables_of

    planned = plan(seeds, hours)
    if not planned:
        return []
    with frame_bar() as bar:
        task = bar.add_task("made breathing", total=len(planned))
        return tables_of(run(planned, jobs, lambda done: bar.update(task, completed=done)))


def _listen(traces: list[Path], sense: "RpmSense") -> "list[Recorded]":
    from engine.evaluation.breath_recorded import listen_to

    with frame_bar() as bar:
        task = bar.add_task("recorded breathing", total=len(traces))
        recorded = []
        for number, path in enumerate(traces):
            recorded.append(listen_to(path, sense))
            bar.update(task, completed=number + 1)
    return recorded


def _recorded_tables(recorded: "list[Recorded]") -> "list[Table]":
    from engine.evaluation.breath_tables import agreement, recorded_events, recorded_shares

    if not recorded:
        return []
    rpm = agreement(recorded)
    return [recorded_shares(recorded), recorded_events(recorded), *([] if rpm is None else [rpm])]


def _draw(recorded: "list[Recorded]", out: Path) -> None:
    from engine.evaluation.breath_pictures import draw_breathing

    for number, one in enumerate(recorded):
        picture = draw_breathing(one.name, one.time_s, one.value_mm, one.told)
        # Two folders may hold files of one name.
        is_twice = any(other.name == one.name for other in recorded[:number])
        name = f"{one.name}.{number}" if is_twice else one.name
        write_whole(out / f"{name}.png", picture.png)
