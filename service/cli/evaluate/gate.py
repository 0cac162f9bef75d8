"""``tidegate evaluate gate``: delays of the beam edges relative to the true motion."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from engine.core.errors import InvalidValueError, TidegateError
from engine.core.files import write_whole
from service.cli.evaluate.bench import PIPED_WIDTH, rich_table
from service.cli.terminal import advance, frame_bar, refused, say


def gate(
    out: Annotated[Path, typer.Option(help="Folder for gate_edges.csv.")],
    work: Annotated[Path | None, typer.Option(help="Folder that keeps the recordings; OUT/work by default.")] = None,
    seconds: Annotated[float, typer.Option(help="Length of each recording [s].")] = 60.0,
    seed: Annotated[
        int, typer.Option(help="Seed of the recordings; the same seed gives the same ones on the same processor.")
    ] = 2017,
    *,
    is_strict: Annotated[
        bool, typer.Option("--strict", help="Exit code 1 when an edge is later than allowed.")
    ] = False,
) -> None:
    """Gate five virtual volunteers with windows of every kind and compare each edge with that of the true motion."""
    from engine.verification.evaluation.gating.tables import gate_table
    from engine.verification.evaluation.gating.timing import EdgeTiming, plan, time_gate
    from engine.verification.evaluation.runs.datasets import check_plan

    try:
        check_plan(seed, seconds)
        if not seconds >= 40.0:
            raise InvalidValueError("seconds", seconds, "at least 40: a breath hold comes after 20 s of free breathing")
        for folder, field in ((out, "out"), (work, "work")):
            if folder is not None and folder.exists() and not folder.is_dir():
                raise InvalidValueError(field, str(folder), "a folder")
        runs = plan(seed, seconds)
        timings: list[EdgeTiming] = []
        with frame_bar() as bar:
            for run in runs:
                task = bar.add_task(f"{run.name}, {run.scenario}", total=2 * run.frames)
                timings += time_gate(run, (work or out / "work") / run.name, partial(advance, bar, task))
        table = gate_table(timings, runs[0].fps)
        out.mkdir(parents=True, exist_ok=True)
        write_whole(out / "gate_edges.csv", table.to_csv().encode())
    except TidegateError as error:
        raise refused("evaluate gate", error) from error
    except OSError as error:
        raise refused("evaluate gate", f"{out} cannot be written ({error.strerror or error})") from error
    console = Console()
    (console if console.is_terminal else Console(width=PIPED_WIDTH)).print(rich_table(table))
    say(f"Written to {out / 'gate_edges.csv'}")
    if is_strict and table.failed:
        raise typer.Exit(1)
