"""The contract files in the repository: OpenAPI, and both streams as JSON Schema."""

import json
import re
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from pydantic import TypeAdapter

from service.core.schemas import coach_messages, live_messages

OPENAPI_NAME = "openapi.json"
LIVE_NAME = "live.schema.json"
COACH_NAME = "coach.schema.json"
INNERMOST = re.compile(r"[\[{][^\[\]{}]*[\]}]")
LONGEST_LINE = 100


def contract_files(app: FastAPI) -> dict[str, str]:
    """Return the text of each contract file, by name."""
    return {
        OPENAPI_NAME: _text(app.openapi()),
        LIVE_NAME: _schema(live_messages.LIVE_MESSAGE, live_messages.SCHEMA),
        COACH_NAME: _schema(coach_messages.COACH_MESSAGE, coach_messages.SCHEMA),
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


def _schema(messages: TypeAdapter[Any], title: str) -> str:
    schema = messages.json_schema(mode="serialization")
    return _text({"$schema": "https://json-schema.org/draft/2020-12/schema", "title": title, **schema})


def _text(document: object) -> str:
    """Return the document as text; what fits on one line is written on one."""
    text = json.dumps(document, indent=1, sort_keys=True, ensure_ascii=False)
    return INNERMOST.sub(_on_one_line, text) + "\n"


def _on_one_line(found: re.Match[str]) -> str:
    line = f"{found[0][0]}{' '.join(found[0][1:-1].split())}{found[0][-1]}"
    return line if "\n" in found[0] and len(line) <= LONGEST_LINE else found[0]
