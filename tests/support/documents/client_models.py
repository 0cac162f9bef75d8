"""The part of the client that the contract makes: ``python -m tests.support.documents.client_models [--write]``.

Every answer and request that a method of the client knows becomes a ``TypedDict`` with the names, types and optionality
of the contract.
"""

import json
import re
import subprocess
import sys
import textwrap
from collections.abc import Iterator
from typing import Any

from tests.support.client.operations import OPERATIONS, contract, live_contract
from tests.support.repository import ROOT

CLIENT = ROOT / "service" / "client.py"
BEGIN, END = "# <made: answers>\n", "# </made: answers>\n"
PLAIN = {"string": "str", "integer": "int", "number": "float", "boolean": "bool", "null": "None"}
WIDTH = 112


def made_part() -> str:
    """Write the types, those that others are made of first."""
    document, live = contract(), live_contract()
    schemas = {**live["$defs"], **document["components"]["schemas"]}
    ordered: dict[str, None] = {}
    messages = _type(live)
    for name in sorted({*_roots(document), *messages.split(" | ")}):
        _gather(name, schemas, ordered)
    written = [_declared(name, schemas[name]) for name in ordered]
    return "\n\n".join(["", *written, f"LiveMessage = {messages}", "", ""]).replace("\n\n\n\n", "\n\n\n")


def schema_of(operation: dict[str, Any]) -> str | None:
    """Name the schema of an operation's answer, where it is JSON."""
    for status, answer in operation["responses"].items():
        schema = answer.get("content", {}).get("application/json", {}).get("schema", {})
        if status.startswith("2") and "$ref" in schema:
            return _name(schema["$ref"])
    return None


def _roots(document: dict[str, Any]) -> Iterator[str]:
    for method, path in OPERATIONS.values():
        operation = document["paths"][path][method.lower()]
        answer = schema_of(operation)
        if answer is not None:
            yield answer
        asked = operation.get("requestBody", {}).get("content", {}).get("application/json", {}).get("schema", {})
        if "$ref" in asked:
            yield _name(asked["$ref"])


def _gather(name: str, schemas: dict[str, Any], ordered: dict[str, None]) -> None:
    if name in ordered:
        return
    for other in re.findall(r'"\$ref": "([^"]+)"', _flat(schemas[name])):
        _gather(_name(other), schemas, ordered)
    ordered[name] = None


def _flat(schema: object) -> str:
    return json.dumps(schema)


def _name(reference: str) -> str:
    return reference.rsplit("/", 1)[-1]


def _declared(name: str, schema: dict[str, Any]) -> str:
    python_name = name.replace("-", "")
    if "properties" not in schema:
        return f"{python_name} = {_type(schema)}"
    required = set(schema.get("required", ()))
    summary = (schema.get("description") or f"{python_name}.").strip().splitlines()[0].replace("\\", "")
    lines = [f"class {python_name}(TypedDict):", *_summary(summary), ""]
    for field, reported in schema["properties"].items():
        kind = _type(reported)
        lines.append(f"    {field}: {kind if field in required else f'NotRequired[{kind}]'}")
    return "\n" + "\n".join(lines)


def _summary(text: str) -> list[str]:
    if len(text) <= WIDTH:
        return [f'    """{text}"""']
    first, *rest = textwrap.wrap(text, WIDTH)
    return [f'    """{first}', *(f"    {line}" for line in rest), '    """']


def _type(schema: dict[str, Any]) -> str:
    if "$ref" in schema:
        return _name(schema["$ref"]).replace("-", "")
    if "const" in schema or "enum" in schema:
        choices = schema.get("enum") or [schema["const"]]
        return f"Literal[{', '.join(_quoted(one) for one in choices)}]"
    choices = schema.get("anyOf") or schema.get("oneOf")
    if choices:
        return " | ".join(dict.fromkeys(_type(one) for one in choices))
    kind = schema.get("type")
    if kind == "array":
        return f"list[{_type(schema.get('items', {}))}]"
    if kind == "object":
        values = schema.get("additionalProperties")
        return f"dict[str, {_type(values) if isinstance(values, dict) else 'object'}]"
    return PLAIN.get(kind, "object")


def _quoted(value: object) -> str:
    return repr(value).replace("'", '"') if isinstance(value, str) else repr(value)


def with_made_part(text: str, part: str) -> str:
    """Put a made part between the marks."""
    before, rest = text.split(BEGIN)
    _, after = rest.split(END)
    return f"{before}{BEGIN}{part}{END}{after}"


def formatted(text: str) -> str:
    """Lay a source out as the repository does."""
    command = [sys.executable, "-m", "ruff", "format", "--stdin-filename", str(CLIENT), "-"]
    return subprocess.run(command, input=text, capture_output=True, text=True, check=True, cwd=ROOT).stdout


def main() -> None:
    text = formatted(with_made_part(CLIENT.read_text(), made_part()))
    if "--write" in sys.argv[1:]:
        CLIENT.write_text(text)
    else:
        sys.stdout.write(made_part())


if __name__ == "__main__":
    main()
