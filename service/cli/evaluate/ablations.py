"""``tidegate evaluate ablations``: the effect of each part of the method."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from engine.core.errors import TidegateError
from engine.core.files import write_whole
from service.cli.evaluate.bench import print_tables
from service.cli.terminal import advance, frame_bar, refused, say


def ablations(
    out: Annotated[Path, typer.Option(help="Folder for ablations.csv.")],
    work: Annotated[
        Path | None, typer.Option(help="Folder of the recordings of `tidegate evaluate`; OUT/work by default.")
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Seed of the recordings; the same seed gives the same ones on the same processor.")
    ] = 2017,
    sensor: Annotated[str, typer.Option(help="Model of the sensor's errors: usual or locking.")] = "usual",
    scenario: Annotated[
        list[str] | None, typer.Option(help="Only this scenario: regular, irregular, shift, dibh, isovolume or drift.")
    ] = None,
) -> None:
    """Measure six virtual volunteers with one part of the method changed at a time and print the errors."""
    from engine.lab.evaluation.runs.ablations import ablate, runs, table
    from engine.lab.evaluation.runs.datasets import SECONDS, check_plan

    try:
        check_plan(seed, SECONDS)
        planned, found = runs(seed, sensor, tuple(scenario or ())), []
        with frame_bar() as bar:
            for run in planned:
                task = bar.add_task(f"{run.name}, {run.scenario}", total=run.frames)
                folder = (work or out / "work") / run.name
                found.append(ablate(run, folder, partial(advance, bar, task)))
        shown = table(found)
        out.mkdir(parents=True, exist_ok=True)
        write_whole(out / "ablations.csv", shown.to_csv().encode())
    except TidegateError as error:
        raise refused("evaluate ablations", error) from error
    except OSError as error:
        raise refused("evaluate ablations", f"{out} cannot be written ({error.strerror or error})") from error
    print_tables([shown])
    say(f"Written to {out / 'ablations.csv'}")
