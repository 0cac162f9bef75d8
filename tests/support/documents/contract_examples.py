"""Examples of requests and answers, taken from a service on fakes.

Run: ``python -m tests.support.documents.contract_examples --write``.

What differs from one run to the next (ids, times, hashes, secrets) is put into one form, so that what changes in the
file is what changed in the contract.
"""

import argparse
import json
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

from schemathesis.python import asgi

from service.web.openapi.examples import FILE
from tests.support.contract.populated_service import ADMIN, World

JSON = "application/json"
TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d(\.\d+)?(Z|\+00:00)")
HASH, IDENTIFIER, KEY_ID = (re.compile(rf"\b[0-9a-f]{{{length}}}\b") for length in (64, 32, 12))
SECRET = re.compile(r"tg_[0-9a-f]{12}_[\w-]+")
QUERY = {"read_qa_trend": "?check=camera_distance_mm"}
YAML = """%YAML:1.0
---
depth_width: 640
depth_height: 480
"""
FURTHER: dict[str, dict[str, dict[str, str]]] = {
    "upload_calibration": {
        "request": {"application/yaml": YAML, "application/xml": "<opencv_storage>...</opencv_storage>\n"}
    },
    "read_metrics": {"answer": {"application/openmetrics-text": "tidegate_ready 1\n# EOF\n"}},
}
"""Of media types that the run does not ask for."""
LONGEST_LIST = 3
LONGEST_TEXT = 600
NOT_ASKED = frozenset({"begin_oidc_login", "finish_oidc_login", "stream_events"})
"""Go elsewhere, or never end; their routers say what they look like."""
NO_EXAMPLE = ("image/", "application/pdf", "application/vnd.apache", "application/dicom")


def made_examples(world: World) -> dict[str, dict[str, Any]]:
    """Ask every operation once, and keep what was sent and reported."""
    found: dict[str, dict[str, Any]] = {}
    for path, item in world.app.openapi()["paths"].items():
        for method, operation in item.items():
            name = operation["operationId"]
            if name not in NOT_ASKED:
                found[name] = _example(world, method.upper(), path, operation)
    for name, parts in FURTHER.items():
        for part, texts in parts.items():
            found[name][part] = found[name].get(part, {}) | texts
    return {name: example for name, example in found.items() if example}


def _example(world: World, method: str, path: str, operation: dict[str, Any]) -> dict[str, Any]:
    name = operation["operationId"]
    world.ready(name)
    headers = world.headers(ADMIN, name)
    parameters = world.parameters(name, headers)
    body = world.body(name, {}) if "requestBody" in operation else None
    place = path.format(**{key: parameters.get(key, "") for key in re.findall(r"\{(\w+)\}", path)})
    sent = {**headers, "Content-Type": "application/dicom" if isinstance(body, bytes) else JSON}
    data = body if isinstance(body, bytes) else None if body is None else json.dumps(body)
    answer = world.client.request(method, f"http://{asgi.HOST}{place}{QUERY.get(name, '')}", data=data, headers=sent)
    world.client.cookies.clear()
    if answer.status_code >= 300:
        sys.stderr.write(f"{name}: {answer.status_code} {answer.text[:200]}\n")
        return {}
    example: dict[str, Any] = {}
    if isinstance(body, dict):
        example["request"] = {JSON: _shortened(_stilled(body))}
    media_type = answer.headers.get("content-type", "").partition(";")[0]
    if media_type == JSON and answer.content:
        example["answer"] = {JSON: _shortened(_stilled(answer.json()))}
    elif answer.content and not media_type.startswith(NO_EXAMPLE):
        example["answer"] = {media_type: _stilled(answer.text[:LONGEST_TEXT].rpartition("\n")[0] + "\n")}
    return example


def _stilled(value: Any) -> Any:
    """Put what changes from run to run into one form."""
    if isinstance(value, dict):
        return {key: _stilled(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_stilled(part) for part in value]
    if not isinstance(value, str):
        return value
    text = SECRET.sub("tg_0123456789ab_shown-once", value)
    text = TIME.sub("2026-11-22T08:30:00.000000Z", text)
    text = IDENTIFIER.sub("0f8fad5bd9cb469fa16570867728950e", HASH.sub("e3b0c44298fc1c149afbf4c8996fb924" * 2, text))
    return KEY_ID.sub("0123456789ab", text)


def _shortened(value: Any) -> Any:
    """Keep the first few of a long list."""
    if isinstance(value, dict):
        return {key: _shortened(part) for key, part in value.items()}
    if isinstance(value, list):
        return [_shortened(part) for part in value[:LONGEST_LIST]]
    return value


def main() -> None:
    """Print the examples, or write them where the contract takes them from."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true")
    with tempfile.TemporaryDirectory(prefix="tidegate-examples-") as folder, World(Path(folder)).open() as world:
        text = json.dumps(made_examples(world), indent=1, sort_keys=True, ensure_ascii=False) + "\n"
    if parser.parse_args().write:
        FILE.write_text(text, encoding="utf-8")
    else:
        sys.stdout.write(text)


if __name__ == "__main__":
    main()
