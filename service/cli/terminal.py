"""How the commands speak on a terminal: one line for a refusal, one bar for frames."""

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

BAD_INPUT = 2
"""The exit code when what was asked for cannot be done with what was given."""


def say(text: str, style: str | None = None) -> None:
    """Print one line on standard error, however long, exactly as it is."""
    Console(stderr=True).print(text, style=style, soft_wrap=True, markup=False, highlight=False)


def refused(command: str, message: object) -> typer.Exit:
    """Say in one line why ``command`` does not go on; return what to raise."""
    say(f"tidegate {command}: {message}", "red")
    return typer.Exit(BAD_INPUT)


def frame_bar() -> Progress:
    """Return a progress bar that counts frames, on standard error."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
