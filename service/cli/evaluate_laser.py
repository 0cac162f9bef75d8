"""``tidegate evaluate plane`` and ``tidegate evaluate laser``: the laser line as the instrument."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import refused


def plane(
    pictures: Annotated[list[Path], typer.Argument(help="Pictures of the laser line on a checkerboard.")],
) -> None:
    """Find the laser's plane from pictures of its line on a checkerboard."""
    raise refused("evaluate plane", f"is being built ({len(pictures)} pictures)")


def laser(recording: Annotated[Path, typer.Argument(help="An .oni recording.", metavar="REC.oni")]) -> None:
    """Judge the measurement by a laser line seen in the recording."""
    raise refused("evaluate laser", f"is being built ({recording})")
