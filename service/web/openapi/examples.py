"""Examples of requests and answers, by operation: recorded from a real run, in ``examples.json``.

``python -m tests.support.documents.contract_examples --write`` records them again; a test validates each against its
schema.
"""

import json
from functools import cache
from pathlib import Path
from typing import Any

FILE = Path(__file__).with_name("examples.json")


@cache
def kept_examples() -> dict[str, dict[str, Any]]:
    """Read the examples: operation -> ``request`` or ``answer`` -> media type -> example."""
    read: dict[str, dict[str, Any]] = json.loads(FILE.read_text(encoding="utf-8"))
    return read


def add_examples(operation: dict[str, Any]) -> None:
    """Insert an operation's examples into the document."""
    kept = kept_examples().get(operation["operationId"], {})
    _put(operation.get("requestBody", {}).get("content", {}), kept.get("request", {}))
    for status, answer in operation["responses"].items():
        if status.startswith("2"):
            _put(answer.get("content", {}), kept.get("answer", {}))


def _put(content: dict[str, Any], examples: dict[str, Any]) -> None:
    for media_type, part in content.items():
        if media_type in examples and not {"example", "examples"} & part.keys():
            part["example"] = examples[media_type]
