"""``tidegate info`` and ``tidegate record``: print what a recording contains, and make one."""

import json
import signal
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from engine.capture import RecordingDescription, StreamSummary, describe
from engine.core.errors import TidegateError

_EXIT_BAD_INPUT = 2


def info(
    file: Annotated[Path, typer.Argument(help="An .oni recording.", show_default=False)],
    *,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    is_quick: Annotated[bool, typer.Option("--quick", help="Read the index only; do not decode the pictures.")] = False,
) -> None:
    """Print what an .oni recording contains and check it for damage.

    Exit code 0 when it is intact, 2 when it is damaged, cannot be read, or has times that no camera gives.
    """
    try:
        with recording_bar("checking" if not is_quick else "reading") as bar:
            task = bar.add_task(file.name, total=None)
            description = describe(
                file,
                is_checked=not is_quick,
                on_progress=lambda done, total: bar.update(task, completed=done, total=total),
            )
    except TidegateError as error:
        raise _failed(error) from error
    if as_json:
        sys.stdout.write(json.dumps(description.document(), indent=2) + "\n")
    else:
        _print_table(description)
    trouble = description.damage or description.impossible_times
    if trouble is not None:
        sys.stderr.write(f"{trouble}\n")
        raise typer.Exit(_EXIT_BAD_INPUT)


def record(
    *,
    out: Annotated[Path, typer.Option("--out", help="The .oni file to write.", show_default=False)],
    seconds: Annotated[
        float, typer.Option("--seconds", help="Length of the recording [s].", min=0.1, max=86_400.0)
    ] = 60.0,
    source: Annotated[
        str | None,
        typer.Option(
            "--source",
            help="Address of a device, an .oni file, or a .bag or .db3 of a maker's SDK; the first device by default.",
        ),
    ] = None,
) -> None:
    """Record depth and colour from a camera to an .oni file.

    Ctrl-C stops early and keeps the frames recorded so far.
    """
    from engine.capture import recorder
    from engine.core.clock import MonotonicClock

    stop_signals: list[int] = []
    previous = signal.signal(signal.SIGINT, lambda number, _frame: stop_signals.append(number))
    try:
        with recording_bar("recording", "{task.fields[frames]} frames, {task.fields[missed]} missed") as bar:
            task = bar.add_task(out.name, total=seconds, frames=0, missed=0)
            description = recorder.record(
                source,
                out,
                seconds=seconds,
                clock=MonotonicClock(),
                on_progress=lambda progress: bar.update(
                    task, completed=progress.seconds, frames=progress.frames, missed=progress.missed_frames
                ),
                is_stop_requested=lambda: bool(stop_signals),
            )
    except TidegateError as error:
        raise _failed(error) from error
    finally:
        signal.signal(signal.SIGINT, previous)
    _print_table(description)


def recording_bar(verb: str, *columns: str) -> Progress:
    """Return a progress bar of frames; disabled where standard error is no terminal."""
    return Progress(
        TextColumn(f"{verb} {{task.description}}"),
        BarColumn(),
        *(TextColumn(column) for column in columns),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=True,
        disable=not sys.stderr.isatty(),
    )


def _failed(error: TidegateError) -> typer.Exit:
    sys.stderr.write(f"{' '.join(str(error).split())}\n")
    return typer.Exit(_EXIT_BAD_INPUT)


def _print_table(description: RecordingDescription) -> None:
    table = Table(title=description.name, title_justify="left", show_edge=False)
    table.add_column("")
    table.add_column("depth", justify="right")
    streams = [description.depth]
    if description.color is not None:
        table.add_column("colour", justify="right")
        streams.append(description.color)
    rows = [_column(stream) for stream in streams]
    for name in rows[0]:
        table.add_row(name, *(row[name] for row in rows))
    console = Console()
    console.print(table)
    console.print(
        f"\n{description.duration_s:.2f} s, {description.file_bytes / 1e6:.1f} MB, format {description.version}, "
        f"{f'camera {description.serial}, ' if description.serial else ''}"
        f"{_verdict(description)}",
        highlight=False,
    )


def _verdict(description: RecordingDescription) -> str:
    if description.damage is not None:
        return "damaged: only the frames above can be read"
    if description.impossible_times is not None:
        return "its times are impossible: it cannot be measured"
    return "all pictures decode" if description.is_checked else "index intact; pictures not checked"


def _column(stream: StreamSummary) -> dict[str, str]:
    claimed = "" if stream.claimed_frames in {None, stream.frames} else f" of {stream.claimed_frames}"
    rate = "unknown" if stream.measured_fps is None else f"{stream.measured_fps:.2f}"
    gaps = len(stream.gaps)
    return {
        "pictures": f"{stream.width}x{stream.height}",
        "coded as": stream.codec,
        "frames": f"{stream.frames}{claimed}",
        "missing": f"{stream.missed_frames}" + (f" in {gaps} gap{'s' * (gaps > 1)}" if gaps else ""),
        "frames/s": f"{rate} (nominal {stream.nominal_fps})",
        "MB": f"{stream.coded_bytes / 1e6:.1f}",
        "shift table": "yes" if stream.has_shift_table else "no",
        "stored mirrored": "yes: turned round when read" if stream.is_mirrored else "no",
    }
