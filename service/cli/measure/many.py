"""``tidegate measure`` of several recordings in parallel, with a summary row for each, also when others fail."""

import csv
import io
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table

from engine.core.files import write_whole
from engine.offline import FileOutcome, FileTask, Progress
from service.cli.measure.options import SUMMARY_NAME
from service.cli.terminal import frame_bar

COLUMNS = (
    *("file", "folder", "calibration", "frames", "measured", "lost", "missed_frames", "cycles", "whole_pp_mm"),
    *("residual_mean_mm", "residual_max_mm", "recording_s", "seconds", "fps", "error", "note"),
    "in_training",
)
_SHOWN = {
    "file": "file",
    "frames": "frames",
    "in_training": "training",
    "measured": "measured",
    "lost": "lost",
    "missed_frames": "missed",
    "cycles": "cycles",
    "whole_pp_mm": "p-p mm",
    "residual_mean_mm": "residual mm",
    "residual_max_mm": "largest",
    "seconds": "s",
    "fps": "fps",
    "error": "error",
}
"""Printed columns and their headings."""
_WIDTH = 160  # of the table in a file or pipe [characters]

MeasureAll = Callable[
    [Sequence[FileTask], Callable[[int, Progress], None], Callable[[int, FileOutcome], None]], list[FileOutcome]
]
"""Measures recordings, on this machine or on others; calls back with a task's position and its progress or outcome."""


def measure_many(tasks: Sequence[FileTask], measure_all: MeasureAll, out: Path) -> bool:
    """Measure all recordings, write ``summary.csv`` and print it; return whether all succeeded."""
    out.mkdir(parents=True, exist_ok=True)
    outcomes = measure_with_bar(tasks, measure_all)
    rows = [summary_row(task, outcome) for task, outcome in zip(tasks, outcomes, strict=True)]
    _save(rows, out / SUMMARY_NAME)
    _show(rows)
    return all(outcome.error is None for outcome in outcomes)


def summary_row(task: FileTask, outcome: FileOutcome) -> dict[str, str]:
    """Return the row of ``summary.csv`` for an outcome; an unknown value is empty, never zero."""
    summary = outcome.summary
    row = {
        "file": str(task.recording),
        "folder": str(task.out),
        "calibration": str(task.calibration),
        "frames": str(outcome.frames if summary is None else summary.frames),
        "seconds": f"{outcome.seconds:.2f}" if outcome.seconds > 0.0 else "",
        "fps": f"{outcome.frames / outcome.seconds:.1f}" if outcome.frames and outcome.seconds > 0.0 else "",
        "error": outcome.error or "",
    }
    if summary is not None:
        row |= {
            name: str(getattr(summary, name)) for name in ("in_training", "measured", "lost", "missed_frames", "cycles")
        }
        row |= {
            name: _number(getattr(summary, name)) for name in ("whole_pp_mm", "residual_mean_mm", "residual_max_mm")
        }
        row |= {"recording_s": f"{summary.recording_s:.3f}", "note": summary.shortcoming or ""}
    return {name: row.get(name, "") for name in COLUMNS}


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"


def measure_with_bar(tasks: Sequence[FileTask], measure_all: MeasureAll) -> list[FileOutcome]:
    """Measure recordings with one progress bar of their frames; return the outcomes in the order of the tasks."""
    done = [Progress(frames=0, total=0)] * len(tasks)
    ended: list[int] = []
    with frame_bar() as bar:
        shown = bar.add_task("", total=None)

        def show() -> None:
            total = sum(progress.total for progress in done)
            bar.update(
                shown,
                completed=sum(progress.frames for progress in done),
                total=total or None,
                description=f"{len(ended)} of {len(tasks)} recordings",
            )

        def on_progress(position: int, progress: Progress) -> None:
            done[position] = progress
            show()

        def on_outcome(position: int, outcome: FileOutcome) -> None:
            ended.append(position)
            done[position] = Progress(frames=outcome.frames, total=outcome.frames)
            show()

        show()
        return measure_all(tasks, on_progress, on_outcome)


def _save(rows: list[dict[str, str]], path: Path) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(path, text.getvalue().encode())


def _show(rows: list[dict[str, str]]) -> None:
    table = Table(box=None, pad_edge=False)
    for name, heading in _SHOWN.items():
        is_text = name in {"file", "error"}
        table.add_column(heading, justify="left" if is_text else "right", overflow="fold", no_wrap=not is_text)
    for row in rows:
        table.add_row(*(row[name] for name in _SHOWN), style="red" if row["error"] else None)
    console = Console(markup=False, highlight=False)
    if not console.is_terminal:
        console = Console(markup=False, highlight=False, width=_WIDTH)
    console.print(table)
