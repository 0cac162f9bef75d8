"""``tidegate openapi``: writes the contracts that the repository keeps."""

from pathlib import Path
from typing import Annotated

import typer


def openapi(
    out: Annotated[Path, typer.Option(help="Folder for openapi.json, live.schema.json and asyncapi.json.")],
) -> None:
    """Write the OpenAPI document, and the live stream's JSON Schema and AsyncAPI document."""
    from service.app import create_app
    from service.openapi import write_contracts
    from service.settings import Settings

    for path in write_contracts(create_app(Settings()), out):
        typer.echo(path)
