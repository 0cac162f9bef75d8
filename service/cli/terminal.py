"""How the commands speak on a terminal: one line for a refusal, one bar for frames.

Rich is imported where a bar is drawn: it takes a tenth of a command's start, and a batch run has no one to draw for.
"""

import sys
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, cast

import typer

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

BAD_INPUT = 2
"""The exit code when what was asked for cannot be done with what was given."""


def say(text: str, style: str | None = None) -> None:
    """Print one line on standard error, however long, exactly as it is; coloured on a terminal."""
    typer.secho(text, fg=style, err=True)


def refused(command: str, message: object) -> typer.Exit:
    """Say in one line why ``command`` does not go on; return what to raise."""
    say(f"tidegate {command}: {message}", "red")
    return typer.Exit(BAD_INPUT)


class NoBar:
    """Takes what a progress bar takes and draws nothing."""

    def add_task(self, description: str, *, total: float | None) -> "TaskID":  # noqa: ARG002
        """Return some number."""
        return cast("TaskID", 0)

    def update(self, task: "TaskID", **progress: Any) -> None:  # noqa: ANN401
        """Draw nothing."""


def frame_bar() -> AbstractContextManager["Progress | NoBar"]:
    """Return a progress bar that counts frames, on standard error; none where that is no terminal."""
    if not sys.stderr.isatty():
        return nullcontext(NoBar())
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )


def advance(bar: "Progress | NoBar", task: "TaskID", done: int) -> None:
    """Show how many frames are done."""
    bar.update(task, completed=done)
