"""The contract files in the repository: OpenAPI, and the live stream as JSON Schema and AsyncAPI."""

import json
from pathlib import Path

from fastapi import FastAPI

from service.core.schemas.live_messages import LIVE_MESSAGE, SCHEMA
from service.web.openapi.asyncapi import asyncapi_document

OPENAPI_NAME = "openapi.json"
LIVE_NAME = "live.schema.json"
ASYNCAPI_NAME = "asyncapi.json"


def contract_files(app: FastAPI) -> dict[str, str]:
    """Return the text of each contract file, by name."""
    live = LIVE_MESSAGE.json_schema(mode="serialization")
    live = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": SCHEMA, **live}
    return {
        OPENAPI_NAME: _text(app.openapi()),
        LIVE_NAME: _text(live),
        ASYNCAPI_NAME: _text(asyncapi_document()),
    }


def write_contracts(app: FastAPI, folder: Path) -> list[Path]:
    """Write the contract files into a folder; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, text in contract_files(app).items():
        path = folder / name
        path.write_text(text, encoding="utf-8")
        written.append(path)
    return written


def _text(document: object) -> str:
    return json.dumps(document, indent=2, sort_keys=True, ensure_ascii=False) + "\n"
