"""``tidegate evaluate integrity``: falsified recordings, and what of them is reported as measured.

``tidegate evaluate ablations``: the effect of each part of the method; ``budget``: the share of each cause of error.
``tidegate evaluate sensor``: what readings of still surfaces say of a camera.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import typer

from engine.core.bounds import check_whole_number
from engine.core.errors import InvalidValueError, TidegateError
from engine.core.files import write_whole
from lab.commands.evaluate.bench import STOPPED, print_tables
from service.cli.terminal import NoBar, advance, frame_bar, refused, say

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

    from lab.evaluation.integrity.cases import Case
    from lab.evaluation.table import Table

WIDTH = 200


SCENARIOS = ("regular", "irregular", "shift", "dibh", "isovolume", "drift")
Out = Annotated[Path, typer.Option(help="Folder for the table, as CSV.")]
Work = Annotated[Path | None, typer.Option(help="Folder of the recordings; OUT/work by default.")]
Seed = Annotated[int, typer.Option(help="Seed of the recordings.")]
First = Annotated[int, typer.Option(help="Number of the first drawn sensor.")]
Number = Annotated[int, typer.Option("--draws", help="How many sensors are drawn.")]
Kinds = Annotated[list[str] | None, typer.Option("--scenario", help="Kinds of breathing; regular and isovolume.")]
Jobs = Annotated[int, typer.Option(help="Processes.")]


def integrity(
    out: Annotated[Path, typer.Option(help="Folder for a CSV file for each sensor.")],
    volunteer: Annotated[
        list[int] | None, typer.Option(help="Virtual volunteer, 1 to 10; repeatable. 3 and 6 by default.")
    ] = None,
    kind: Annotated[
        list[str] | None, typer.Option(help="Only cases whose name contains this text; repeatable.")
    ] = None,
    seed: Annotated[
        int, typer.Option(help="Seed of the recordings; the same seed gives the same ones on the same processor.")
    ] = 2017,
    jobs: Annotated[int | None, typer.Option(help="Number of processes; one per core by default.")] = None,
    sensor: Annotated[
        list[str] | None,
        typer.Option(
            help="Sensor, by its errors: usual, locking, active-stereo or time-of-flight; the first two by default."
        ),
    ] = None,
    *,
    is_conditions: Annotated[
        bool,
        typer.Option("--conditions", help="Not false: dim light, shadow, skin, clothing, stickers and a cold camera."),
    ] = False,
    is_slow: Annotated[
        bool, typer.Option("--slow", help="Add what takes longer: moves over a minute, a half that rises slowly.")
    ] = False,
    takes_turns: Annotated[
        bool, typer.Option("--in-turn", help="One volunteer a case, in turn, in place of all: in half the time of two.")
    ] = False,
    is_strict: Annotated[
        bool, typer.Option("--strict", help="Exit code 1 when an error stands as measured for too long.")
    ] = False,
) -> None:
    """Falsify recordings of virtual volunteers, and compare what is reported as measured with the true motion.

    Sheets, re-attached markers, missing depth, moves of body and camera, old pictures, and a patient who lies feet
    first; one row a case, over all volunteers.
    """
    workers = len(os.sched_getaffinity(0)) if jobs is None else jobs
    try:
        if out.exists() and not out.is_dir():
            raise InvalidValueError("out", str(out), "a folder")
        chosen = _chosen(kind or [], is_slow=is_slow, is_conditions=is_conditions)
        name = "conditions" if is_conditions else "integrity"
        tables = _judged(
            chosen, volunteer or [3, 6], sensor or [], seed=seed, jobs=workers, name=name, takes_turns=takes_turns
        )
        out.mkdir(parents=True, exist_ok=True)
        for table in tables:
            write_whole(out / f"{table.name}.csv", table.to_csv().encode())
    except KeyboardInterrupt as stopped:
        say("tidegate evaluate integrity: stopped; nothing is written", "yellow")
        raise typer.Exit(STOPPED) from stopped
    except TidegateError as error:
        raise refused("evaluate integrity", error) from error
    except OSError as error:
        raise refused("evaluate integrity", f"{out} cannot be written ({error.strerror or error})") from error
    print_tables(tables, WIDTH)
    say(f"Written to {out}: {', '.join(f'{table.name}.csv' for table in tables)}")
    if is_strict and any(table.failed for table in tables):
        raise typer.Exit(1)


def _count(bar: "Progress | NoBar", task: "TaskID", done: int) -> None:
    bar.update(task, completed=done)


def _chosen(kinds: list[str], *, is_slow: bool, is_conditions: bool) -> "list[Case]":
    """Return the cases whose name has one of the texts; raise InvalidValueError where there is none."""
    from lab.evaluation.integrity.cases import cases, conditions

    offered = conditions() if is_conditions else cases(is_slow=is_slow)
    chosen = [case for case in offered if not kinds or any(text in case.name for text in kinds)]
    if not chosen:
        raise InvalidValueError("kind", ", ".join(kinds), "a part of the name of a case, such as sheet")
    return chosen


def _judged(
    chosen: "list[Case]",
    volunteers: list[int],
    sensors: list[str],
    *,
    seed: int,
    jobs: int,
    name: str,
    takes_turns: bool,
) -> "list[Table]":
    """Run the cases on each sensor; raise InvalidValueError naming the field that is out of bounds."""
    from lab.evaluation.integrity.bench import check_plan, integrity_table, jobs_of, run_all
    from lab.phantom.sensor import BENCHED, find_sensor

    check_plan(volunteers, seed, jobs)
    for sensor in sensors:
        find_sensor(sensor)
    tables = []
    for turn, sensor in enumerate(dict.fromkeys(sensors or BENCHED)):
        with frame_bar() as bar:
            task = bar.add_task(
                f"recordings, sensor {sensor}", total=jobs_of(chosen, volunteers, takes_turns=takes_turns)
            )
            count = partial(_count, bar, task)
            sessions = run_all(
                chosen,
                volunteers,
                seed=seed,
                jobs=jobs,
                sensor=sensor,
                turn=turn if takes_turns else None,
                on_done=count,
            )
        tables.append(integrity_table(sessions, sensor, name))
    return tables


@contextmanager
def _refusing(command: str, out: Path) -> Iterator[None]:
    """End the command with one line where its input is refused or ``out`` cannot be written."""
    try:
        yield
    except TidegateError as error:
        raise refused(f"evaluate {command}", error) from error
    except OSError as error:
        raise refused(f"evaluate {command}", f"{out} cannot be written ({error.strerror or error})") from error


def _write(table: "Table", out: Path) -> None:
    """Write a table to its CSV file in ``out``, and print it."""
    out.mkdir(parents=True, exist_ok=True)
    write_whole(out / f"{table.name}.csv", table.to_csv().encode())
    print_tables([table], WIDTH)
    say(f"Written to {out / f'{table.name}.csv'}")


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
    from lab.evaluation.runs.ablations import ablate, runs, table
    from lab.evaluation.runs.datasets import SECONDS, check_plan

    with _refusing("ablations", out):
        check_plan(seed, SECONDS)
        planned, found = runs(seed, sensor, tuple(scenario or ())), []
        with frame_bar() as bar:
            for run in planned:
                task = bar.add_task(f"{run.name}, {run.scenario}", total=run.frames)
                folder = (work or out / "work") / run.name
                found.append(ablate(run, folder, partial(advance, bar, task)))
        _write(table(found), out)


def budget(
    out: Annotated[Path, typer.Option(help="Folder for budget.csv.")],
    work: Annotated[Path | None, typer.Option(help="Folder of the recordings; OUT/work by default.")] = None,
    seed: Annotated[
        int, typer.Option(help="Seed of the recordings; the same seed gives the same ones on the same processor.")
    ] = 2017,
    sensor: Annotated[str, typer.Option(help="Model of the sensor's errors: usual, locking, drawn-6.")] = "locking",
    scenario: Annotated[
        list[str] | None, typer.Option(help="Only this scenario: regular, irregular, shift, dibh, isovolume or drift.")
    ] = None,
) -> None:
    """Measure a recording with one cause of error at a time replaced by the truth and print what is left."""
    from lab.evaluation.runs.budget import ROWS, runs, split, table
    from lab.evaluation.runs.datasets import SECONDS, check_plan

    with _refusing("budget", out):
        check_plan(seed, SECONDS)
        planned = runs(seed, sensor, tuple(scenario or ()))
        for name in scenario or ():
            if name not in {run.scenario for run in planned}:
                raise InvalidValueError("scenario", name, "regular, irregular, shift, dibh, isovolume or drift")
        found = []
        with frame_bar() as bar:
            for run in planned:
                task = bar.add_task(f"{run.name}, {run.scenario}", total=len(ROWS))
                folder = (work or out / "work") / f"{run.name}-budget"
                found.append(split(run, folder, partial(_count, bar, task)))
        _write(table(found), out)


def draws(
    out: Out,
    work: Work = None,
    seed: Seed = 2017,
    first: First = 0,
    number: Number = 10,
    scenario: Kinds = None,
    jobs: Jobs = 2,
) -> None:
    """Measure the same breathing on sensors drawn from the ranges between cameras, whole, live and by a simple way."""
    from lab.evaluation.runs.draws import measure_all, runs, table

    with _refusing("draws", out):
        kinds = _checked_draws(seed, first, number, scenario, jobs)
        _write(table(measure_all(runs(seed, first, number, kinds), work or out / "work", jobs)), out)


def tune(
    out: Out,
    work: Work = None,
    seed: Seed = 2017,
    first: First = 100,
    number: Number = 3,
    scenario: Kinds = None,
    jobs: Jobs = 2,
) -> None:
    """Choose the constants of the measurement again on a part of drawn sensors, and judge them on the others."""
    from lab.evaluation.runs.datasets import SECONDS
    from lab.evaluation.runs.draws import runs
    from lab.evaluation.runs.tuning import table, tune_all

    with _refusing("tune", out):
        kinds = _checked_draws(seed, first, number, scenario, jobs)
        _write(table(tune_all(runs(seed, first, number, kinds, SECONDS), work or out / "work", jobs)), out)


def _checked_draws(seed: int, first: int, number: int, scenario: list[str] | None, jobs: int) -> tuple[str, ...]:
    """Return the kinds of breathing; raise InvalidValueError naming what is out of bounds."""
    from lab.evaluation.runs.bench import check_jobs
    from lab.evaluation.runs.datasets import SECONDS, check_plan
    from lab.phantom.sensor import MOST_DRAWN

    check_plan(seed, SECONDS)
    check_jobs(jobs)
    check_whole_number("draws", number, 1, MOST_DRAWN)
    check_whole_number("first", first, 0, MOST_DRAWN - number)
    for name in scenario or ():
        if name not in SCENARIOS:
            raise InvalidValueError("scenario", name, ", ".join(SCENARIOS))
    return tuple(scenario or ("regular", "isovolume"))


def sensor(
    recording: Annotated[
        Path, typer.Argument(help="Recording of a structured-light camera with still surfaces.", metavar="REC.oni")
    ],
    out: Annotated[Path, typer.Option(help="Folder for sensor.csv.")],
    model: Annotated[
        list[str] | None, typer.Option(help="Sensor model beside it; repeatable. usual and locking by default.")
    ] = None,
    *,
    is_fitted: Annotated[
        bool, typer.Option("--fit", help="Fit a model's noise to the recording; takes some minutes.")
    ] = False,
) -> None:
    """Print what a camera's readings of still surfaces say of its errors, beside sensor models on the same surfaces."""
    from engine.capture.recording_source import OniFileSource
    from engine.core.clock import ManualClock
    from lab.evaluation.playback import decoded_frames
    from lab.evaluation.sensor_statistics import MOST_FRAMES, ROUNDS, fit_sensor, simulated, statistics_of, table
    from lab.phantom.sensor import find_sensor

    with _refusing("sensor", out):
        models = {name: find_sensor(name) for name in model or ("usual", "locking")}
        source = OniFileSource(recording, clock=ManualClock(), is_helped=False)
        frames = [frame.depth_mm for frame in islice(decoded_frames(source), MOST_FRAMES)]
        depth_mm = np.array(frames, dtype=np.float32)
        columns = {"recording": statistics_of(depth_mm)}
        if is_fitted:
            with frame_bar() as bar:
                models["fitted"] = fit_sensor(
                    depth_mm, partial(advance, bar, bar.add_task("fitting the noise", total=ROUNDS))
                )
            say(f"Fitted: {models['fitted']}")
        _write(table(columns | {name: statistics_of(simulated(depth_mm, one)) for name, one in models.items()}), out)
