"""``tidegate convert``: a recording in another format."""

from pathlib import Path
from typing import Annotated

import typer

from engine.core.errors import TidegateError
from engine.offline import convert_recording
from service.cli.recordings import recording_bar
from service.cli.terminal import refused, say

DAMAGED = 2


def convert(
    source: Annotated[Path, typer.Argument(help="Recording: .oni, .mcap, or a folder of PNG.", show_default=False)],
    target: Annotated[Path, typer.Argument(help="To write: .oni, .mcap, or a folder.", show_default=False)],
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration of the camera, kept in .mcap and folders.")
    ] = None,
) -> None:
    """Convert a recording between .oni, .mcap and a folder of PNG.

    Depths are equal; JPEG pictures are handed on as they are. Of a source that is cut off every picture before the cut
    is converted, and the exit code is 2. A camera that the source does not name is unknown.
    """
    try:
        with recording_bar("converting", "{task.completed} depth pictures") as bar:
            task = bar.add_task(source.name, total=None)
            done = convert_recording(
                source, target, calibration=calibration, on_progress=lambda count: bar.update(task, completed=count)
            )
    except TidegateError as error:
        raise refused("convert", error) from error
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise refused("convert", f"{getattr(error, 'filename', None) or target} cannot be used ({reason})") from error
    say(f"Written to {target}: {done.depth} depth and {done.color} colour pictures; camera {done.serial}")
    if done.damage is not None:
        say(f"{done.damage}: what comes before is converted", "yellow")
        raise typer.Exit(DAMAGED)
