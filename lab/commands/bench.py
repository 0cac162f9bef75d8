"""``tidegate bench``: speed and memory on this machine, compared with the required values."""

import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table as RichTable

from engine.core.errors import InvalidValueError, TidegateError
from engine.motion import TrainingSettings
from lab.performance.bench import SpeedBench, full_sizes, quick_sizes, write_figures
from lab.performance.machine import BUSY_LOAD, Machine, SpeedBenchError, pinned
from lab.performance.results import SpeedFigures, SpeedMark, reach, speed_tables
from lab.performance.session import Recording, make_recording
from lab.performance.throughput import CommandRun
from service.cli.serve import SWITCH_INTERVAL_S
from service.cli.terminal import frame_bar, refused, say

if TYPE_CHECKING:
    from lab.evaluation.table import Table

STOPPED = 130
PIPED_WIDTH = 160
SECONDS, QUICK_SECONDS = 40.0, 24.0
PARTS = 6
VERDICT_STYLES = {True: "green", False: "red"}


def bench(
    out: Annotated[Path | None, typer.Option(help="Folder for bench.json; nothing is written by default.")] = None,
    *,
    is_quick: Annotated[
        bool, typer.Option("--quick", help="Fewer frames, fits and runs on a shorter recording.")
    ] = False,
    memory_minutes: Annotated[
        float, typer.Option(help="Length of the session for the memory measurement, played at full speed [min].")
    ] = 2.0,
    work: Annotated[
        Path | None, typer.Option(help="Folder that keeps the recording for the next run; a temporary one by default.")
    ] = None,
    is_strict: Annotated[bool, typer.Option("--strict", help="Exit code 1 when a required value is not met.")] = False,
) -> None:
    """Measure the speed of every processing stage and the memory use on this machine.

    Generates its own recording. Run nothing else meanwhile: the load of other programs is printed beside the results
    but cannot be subtracted from them.
    """
    before = signal.signal(signal.SIGTERM, _interrupt)
    try:
        marks = _bench(out, work, is_quick=is_quick, memory_minutes=memory_minutes)
    except KeyboardInterrupt as stopped:
        say("tidegate bench: stopped", "yellow")
        raise typer.Exit(STOPPED) from stopped
    except TidegateError as error:
        raise refused("bench", error) from error
    except OSError as error:
        raise refused("bench", f"{error.filename or out} cannot be written ({error.strerror or error})") from error
    finally:
        signal.signal(signal.SIGTERM, before)
    if is_strict and not all(mark.is_met for mark in marks):
        raise typer.Exit(1)


def _interrupt(_signal: int, _frame: FrameType | None) -> None:
    """Handle SIGTERM like Ctrl-C: child processes end and the temporary folder is removed."""
    raise KeyboardInterrupt


def _bench(out: Path | None, work: Path | None, *, is_quick: bool, memory_minutes: float) -> list[SpeedMark]:
    sizes = (quick_sizes if is_quick else full_sizes)(memory_minutes)
    for folder, field in ((out, "out"), (work, "work")):
        if folder is not None and folder.exists() and not folder.is_dir():
            raise InvalidValueError(field, str(folder), "a folder")
    with _folder(work) as used, frame_bar() as bar:
        shown = bar.add_task("making the recording", total=None)
        folder = make_recording(
            used,
            QUICK_SECONDS if is_quick else SECONDS,
            lambda done, total: bar.update(shown, completed=done, total=total),
        )
        begun: list[str] = []

        def begin(part: str) -> None:
            bar.update(shown, description=part, completed=len(begun), total=PARTS)
            begun.append(part)

        figures = SpeedBench(
            recording=Recording(folder=folder, training=TrainingSettings()),
            work=used,
            run_command=run_measure,
            on_part=begin,
            switch_interval_s=SWITCH_INTERVAL_S,
        ).run(sizes)
    marks = reach(figures)
    show(figures, marks)
    if out is not None:
        say(f"Written to {write_figures(figures, marks, out, command=_command(memory_minutes, is_quick=is_quick))}")
    return marks


def _command(memory_minutes: float, *, is_quick: bool) -> str:
    return "tidegate bench" + (" --quick" if is_quick else "") + f" --memory-minutes {memory_minutes:g}"


@contextmanager
def _folder(work: Path | None) -> Iterator[Path]:
    if work is not None:
        work.mkdir(parents=True, exist_ok=True)
        yield work
        return
    with tempfile.TemporaryDirectory(prefix="tidegate-bench-") as temporary:
        yield Path(temporary)


def run_measure(recordings: list[Path], out: Path, cores: tuple[int, ...], jobs: int) -> CommandRun:
    """Run ``tidegate measure`` as a separate process on these cores."""
    measure = [sys.executable, "-m", "service.cli", "measure", "--single-pass", *map(str, recordings)]
    before_s = _children_s()
    with pinned(cores):
        started = time.perf_counter()
        done = subprocess.run(
            [*measure, "--out", str(out), "--jobs", str(jobs)], capture_output=True, text=True, check=False
        )
        seconds = time.perf_counter() - started
    if done.returncode != 0:
        lines = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
        raise SpeedBenchError(f"tidegate measure failed: {lines[-1]}")
    return CommandRun(seconds=seconds, processor_s=_children_s() - before_s)


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def show(figures: SpeedFigures, marks: list[SpeedMark]) -> None:
    """Print the machine, then every table, the required values last."""
    console = Console() if sys.stdout.isatty() else Console(width=PIPED_WIDTH)
    console.print(_described(figures.machine), "", highlight=False, markup=False)
    for table in speed_tables(figures, marks):
        styles = _verdicts(marks) if table.name == "marks" else {}
        console.print(_rich(table, styles), "")
    loads = ", ".join(f"{load:.1f}" for load in figures.load_averages)
    console.print(f"Load average before each part and at the end: {loads}", highlight=False)
    if figures.machine.is_busy:
        say(
            f"Note: the load average was {figures.machine.load_average:.1f} before the measurement, above "
            f"{BUSY_LOAD:g}: other programs were running, and times are longer than on an idle machine",
            "yellow",
        )
    missed = [mark.name for mark in marks if not mark.is_met]
    if missed:
        say(f"{len(missed)} of {len(marks)} required values not met: {'; '.join(missed)}", "red")
    else:
        say(f"All {len(marks)} required values met", "green")


def _described(machine: Machine) -> str:
    return (
        f"{machine.processor} ({machine.caches}), "
        f"{len(machine.cores)} core{'s' * (len(machine.cores) > 1)}, {machine.memory_gb:g} GB; "
        f"{machine.system}; Python {machine.python}, numpy {machine.numpy}, OpenCV {machine.opencv}; "
        f"frame path: {machine.frame_path}"
    )


def _verdicts(marks: list[SpeedMark]) -> dict[int, str]:
    return {number: VERDICT_STYLES[mark.is_met] for number, mark in enumerate(marks)}


def _rich(table: "Table", styles: dict[int, str]) -> RichTable:
    shown = RichTable(title=escape(table.title), title_justify="left", caption=escape(table.note) or None)
    shown.caption_justify = "left"
    for number, column in enumerate(table.columns):
        shown.add_column(escape(column), justify="left" if number == 0 else "right", overflow="fold")
    for number, row in enumerate(table.rows):
        shown.add_row(*(escape(table.text(cell)) for cell in row), style=styles.get(number))
    return shown
