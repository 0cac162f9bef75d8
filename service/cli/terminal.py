"""Terminal output of the commands: one line for a refusal, one progress bar for frames.

Rich is imported only to draw a bar: the import takes a tenth of a command's start.

The data folder that a command works on: it must exist, so that a mistyped name is refused and not created.
"""

import sys
from contextlib import AbstractContextManager, nullcontext
from typing import TYPE_CHECKING, Any, cast

import typer

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID


BAD_INPUT = 2
"""Exit code of a command that was refused."""


def say(text: str, style: str | None = None) -> None:
    """Print text on standard error without wrapping or markup, coloured on a terminal."""
    typer.secho(text, fg=style, err=True)


def refused(command: str, message: object) -> typer.Exit:
    """Print one line with the reason why ``command`` is refused; return the exception to raise."""
    say(f"tidegate {command}: {message}", "red")
    return typer.Exit(BAD_INPUT)


class NoBar:
    """Progress bar that draws nothing, for output to a file or pipe."""

    def add_task(self, description: str, *, total: float | None) -> "TaskID":  # noqa: ARG002
        """Return a placeholder."""
        return cast("TaskID", 0)

    def update(self, task: "TaskID", **progress: Any) -> None:  # noqa: ANN401
        """Draw nothing."""


def frame_bar() -> AbstractContextManager["Progress | NoBar"]:
    """Return a progress bar on standard error that counts frames; `NoBar` if that is not a terminal."""
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
    """Set the number of frames that are done."""
    bar.update(task, completed=done)
