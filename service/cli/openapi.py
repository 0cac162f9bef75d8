"""``tidegate openapi``: writes the contracts that the repository keeps."""

from pathlib import Path
from typing import Annotated

import typer


def openapi(out: Annotated[Path, typer.Option(help="Folder for openapi.json and live.schema.json.")]) -> None:
    """Write the OpenAPI document and the JSON Schema of the live stream."""
    from service.app import create_app
    from service.openapi import write_contracts
    from service.settings import Settings

    for path in write_contracts(create_app(Settings()), out):
        typer.echo(path)
