"""The two contracts that are kept in the repository: the OpenAPI document and the JSON Schema of the live stream."""

import json
from pathlib import Path
from typing import Any

from fastapi import FastAPI

from service import schemas
from service.access.cookies import PLAIN_NAME
from service.access.rules import RULES, Needs, Open
from service.api import problems
from service.live_messages import LIVE_MESSAGE, SCHEMA

SECURITY_SCHEMES = {
    "login": {
        "type": "apiKey",
        "in": "cookie",
        "name": PLAIN_NAME,
        "description": "Of a person who has logged in; over TLS the name begins with `__Host-`. Calls that change "
        "something must also carry the page's own Origin",
    },
    "key": {
        "type": "http",
        "scheme": "bearer",
        "description": "Of a machine: an API key `tg_...`, or a token of the site's identity provider",
    },
}
OPENAPI_NAME = "openapi.json"
LIVE_NAME = "live.schema.json"


def describe_problems(app: FastAPI) -> None:
    """Add the problem's schema to the document: routes refer to it, none returns it."""
    generate = app.openapi

    def openapi() -> dict[str, object]:
        document = generate()
        components = document.setdefault("components", {}).setdefault("schemas", {})
        components["Problem"] = schemas.Problem.model_json_schema(mode="serialization")
        describe_access(document)
        return document

    app.openapi = openapi  # type: ignore[method-assign]  # FastAPI's documented way to extend the document


def describe_access(document: dict[str, Any]) -> None:
    """Say with every call what it takes, as the table of rules has it."""
    document["components"]["securitySchemes"] = SECURITY_SCHEMES
    for path, item in document["paths"].items():
        for method, operation in item.items():
            _describe_call(operation, RULES.get((method.upper(), path)))


def _describe_call(operation: dict[str, Any], needs: Needs | None) -> None:
    if needs is Open.PUBLIC:
        operation["security"] = []
        return
    is_permission = needs is not None and not isinstance(needs, Open)
    operation["security"] = [{name: []} for name in SECURITY_SCHEMES]
    operation["x-permission"] = str(needs) if is_permission else None
    operation["responses"] |= {str(status): problem for status, problem in problems(401, 403).items()}


def contract_files(app: FastAPI) -> dict[str, str]:
    """Return name and text of each contract file."""
    live = LIVE_MESSAGE.json_schema(mode="serialization")
    live = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": SCHEMA, **live}
    return {OPENAPI_NAME: _text(app.openapi()), LIVE_NAME: _text(live)}


def write_contracts(app: FastAPI, folder: Path) -> list[Path]:
    """Write the contract files; returns where."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for name, text in contract_files(app).items():
        path = folder / name
        path.write_text(text, encoding="utf-8")
        written.append(path)
    return written


def _text(document: object) -> str:
    return json.dumps(document, indent=2, sort_keys=True, ensure_ascii=False) + "\n"
