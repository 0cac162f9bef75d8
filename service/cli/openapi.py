"""``tidegate openapi``: write the API documents that are committed in the repository."""

from pathlib import Path
from typing import Annotated

import typer


def openapi(
    out: Annotated[Path, typer.Option(help="Folder for openapi.json, live.schema.json and coach.schema.json.")],
) -> None:
    """Write the OpenAPI document and the schemas of the live stream."""
    from service.core.settings.settings import Settings
    from service.web.app import create_app
    from service.web.openapi import write_contracts

    for path in write_contracts(create_app(Settings()), out):
        typer.echo(path)
