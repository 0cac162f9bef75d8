"""``tidegate evaluate spirometer``: the measured volume beside a spirometer's."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import refused


def spirometer(recording: Annotated[Path, typer.Argument(help="An .oni recording.", metavar="REC.oni")]) -> None:
    """Judge the measured volume by a spirometer's recording."""
    raise refused("evaluate spirometer", f"is being built ({recording})")
