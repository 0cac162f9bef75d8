"""Pages that the code states: the REST API of `openapi.json`, the settings of their models, the names of `tidegate`."""

import inspect
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]


def python_names() -> str:
    """Return a directive for each name that `tidegate` exports."""
    import tidegate

    lines = []
    for name in sorted(tidegate.__all__):
        found = getattr(tidegate, name)
        own = getattr(found, "__module__", "").startswith("tidegate.")
        if inspect.isclass(found):
            lines += [f".. autoclass:: tidegate.{name}", *(["   :members:"] if own else []), ""]
        elif callable(found):
            lines += [f".. autofunction:: tidegate.{name}", ""]
    return "\n".join(["```{eval-rst}", *lines, "```", ""])


def settings_page() -> str:
    """Return a table of each section's settings: key, default, bounds, and whether a variable overrides it."""
    from service.core.settings.names import OVERRIDES, PREFIX, place_of
    from service.core.settings.qa import CHOSEN
    from service.core.settings.settings import Settings

    sections: dict[str, list[str]] = {}
    for name, field in Settings.model_fields.items():
        section, key = place_of(name)
        if name == CHOSEN:
            continue
        default = getattr(field.default, "value", field.default)
        shown = "" if default is None or default == () else f"`{default}`"
        variable = f"`{PREFIX}{name.upper()}`" if name in OVERRIDES else ""
        row = f"| `{key}` | {shown} | {_bounds(field.metadata)} | {variable} | {field.description or ''} |"
        sections.setdefault(section, []).append(row)
    head = "| key | default | bounds | variable | |\n|---|---|---|---|---|"
    return "\n\n".join(f"## {section}\n{head}\n" + "\n".join(rows) for section, rows in sorted(sections.items())) + "\n"


def _bounds(marks: list[Any]) -> str:
    words = {"ge": "from", "gt": "above", "le": "to", "lt": "below"}
    found = [
        f"{word} {value:g}" for name, word in words.items() for mark in marks if (value := _of(mark, name)) is not None
    ]
    return " ".join(found)


def _of(mark: object, name: str) -> float | None:
    value = getattr(mark, name, None)
    return value if isinstance(value, (int, float)) else None


def rest_page() -> str:
    """Return a section for each operation, by tag: what it takes, what it answers, and its problems."""
    document = json.loads((ROOT / "openapi" / "openapi.json").read_text(encoding="utf-8"))
    tags: dict[str, list[str]] = {}
    for path, item in document["paths"].items():
        for method, operation in item.items():
            if method in {"get", "post", "put", "patch", "delete"}:
                text = "\n".join(_operation(method, path, operation, document))
                tags.setdefault(operation.get("tags", ["other"])[0], []).append(text)
    return "\n".join(f"## {tag}\n\n" + "\n".join(texts) for tag, texts in tags.items())


def _operation(method: str, path: str, operation: dict[str, Any], document: dict[str, Any]) -> Iterator[str]:
    yield f"### {method.upper()} {path}\n"
    yield f"{operation.get('description', operation.get('summary', ''))}\n"
    permission = operation.get("x-permission")
    if permission:
        yield f"Permission: `{permission}`.\n"
    rows = [_row(one["name"], one["schema"], one.get("description", "")) for one in _parameters(operation, document)]
    body = operation.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema", {})
    rows += [_row(name, one, one.get("description", "")) for name, one in _fields(body, document).items()]
    if rows:
        yield "| takes | type | |\n|---|---|---|\n" + "\n".join(rows) + "\n"
    good = [code for code in operation["responses"] if code.startswith("2")]
    yield f"Answers {', '.join(good)}. " + _problems(operation.get("x-problem-codes", {})) + "\n"


def _parameters(operation: dict[str, Any], document: dict[str, Any]) -> list[dict[str, Any]]:
    return [_resolved(one, document) for one in operation.get("parameters", [])]


def _resolved(one: dict[str, Any], document: dict[str, Any]) -> dict[str, Any]:
    found: Any = document
    if "$ref" not in one:
        return one
    for part in one["$ref"].removeprefix("#/").split("/"):
        found = found[part]
    return dict(found)


def _fields(schema: dict[str, Any], document: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return dict(_resolved(schema, document).get("properties", {})) if schema else {}


def _row(name: str, schema: dict[str, Any], description: str) -> str:
    words = description.replace("\n", " ").replace("|", "\\|")
    return f"| `{name}` | {_type(schema)} | {words} |"


def _type(schema: dict[str, Any]) -> str:
    if "$ref" in schema:
        return str(schema["$ref"].rsplit("/", 1)[-1])
    if "enum" in schema:
        return ", ".join(f"`{one}`" for one in schema["enum"])
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(_type(one) for one in schema["anyOf"]))
    low, high = schema.get("minimum"), schema.get("maximum")
    bounds = (
        ""
        if low is None and high is None
        else f" {low if low is not None else ''} to {high if high is not None else ''}"
    )
    return f"{schema.get('type', 'any')}{bounds}"


def _problems(codes: dict[str, list[str]]) -> str:
    named = [f"{status}: {', '.join(f'`{one}`' for one in found)}" for status, found in sorted(codes.items())]
    return f"Problems: {'; '.join(named)}." if named else ""
