"""Completes every operation: request body, access, problems, headers of the answers.

Everything is derived from the operation and the table of access rules; a router declares only its specific problems.

Shared parts of the operations: authentication, headers, tags, the answers of problems.

The contract files in the repository: OpenAPI, and both streams as JSON Schema.
"""

import json
import re
from pathlib import Path
from typing import Any

from fastapi import FastAPI
from pydantic import TypeAdapter

from service.access.login.cookies import PLAIN_NAME
from service.access.request.rules import BEFORE_THE_PASSWORD_IS_CHANGED, RULES, TAKES_PERMISSION_AWAY, Needs, Open
from service.core.conditional import IF_MATCH as IF_MATCH_HEADER, IF_NONE_MATCH as IF_NONE_MATCH_HEADER
from service.core.schemas import coaching, live_messages
from service.storage.database.idempotency import HEADER as IDEMPOTENCY_HEADER
from service.web.api import CODES, PROBLEM_CONTENT, problem_answer

SECURITY_SCHEMES = {
    "login": {
        "type": "apiKey",
        "in": "cookie",
        "name": PLAIN_NAME,
        "description": "Log-in cookie of a person; over TLS its name begins with `__Host-`. Calls "
        "that change data must also send the page's Origin",
    },
    "key": {
        "type": "http",
        "scheme": "bearer",
        "description": "API key `tg_...` of a machine, or an access token of the site's identity provider",
    },
}
TAGS = [
    {"name": "sessions", "description": "A treatment fraction: create, start, arm, monitor, stop."},
    {"name": "plans", "description": "Treatment plans imported from DICOM, and sessions created from them."},
    {"name": "models", "description": "Motion models learned from a patient's breathing."},
    {"name": "calibrations", "description": "Camera calibrations, identified by the hash of their content."},
    {"name": "devices", "description": "Connected cameras."},
    {"name": "recordings", "description": "Recordings that sessions may play."},
    {"name": "interlocks", "description": "All interlocks that hold the beam, with this site's limits."},
    {"name": "qa", "description": "Quality assurance: runs, reports, trends and baseline."},
    {"name": "coaching", "description": "The patient screen: what it shows, and the screens that are paired."},
    {"name": "live", "description": "The live stream of measurements and gate decisions."},
    {"name": "audit", "description": "The append-only audit log: read, verify, export."},
    {"name": "access", "description": "Log-ins, people and API keys."},
    {"name": "health", "description": "Liveness, readiness and metrics."},
]
Operation = dict[str, Any]
Codes = dict[int, set[str]]
IF_MATCH, IF_NONE_MATCH, IDEMPOTENCY_KEY = (
    name.lower() for name in (IF_MATCH_HEADER, IF_NONE_MATCH_HEADER, IDEMPOTENCY_HEADER)
)
"""Header names in lower case, as FastAPI writes them."""
CHANGES = frozenset({"POST", "PUT", "PATCH", "DELETE"})
NOTHING_TO_SAY = {
    "required": True,
    "description": "The content is ignored; the JSON type is required because forms of other origins cannot send it",
    "content": {"application/json": {"schema": {}}},
}
WHO_ASKS = {
    "required": False,
    "description": "`operator` as in other calls; it may be left out. Hold, disarm and stop are "
    "carried out whatever the body is: missing, incomplete, of another type, with "
    "other fields or not JSON. For an API key the audit log records what could not be "
    "read; for a person the log-in's name is used and the body is not read",
    "content": {"application/json": {"schema": {}, "example": {"operator": "A. Therapist"}}},
}
V1 = "/api/v1/"
SHOWN_TO_PEOPLE = "text/html"
WITH_RETRY = frozenset({"idempotency_in_progress", "locked_out", "login_busy", "plan_busy", "stream_full"})
OPENAPI_NAME = "openapi.json"
LIVE_NAME = "live.schema.json"
COACH_NAME = "coach.schema.json"
INNERMOST = re.compile(r"[\[{][^\[\]{}]*[\]}]")
LONGEST_LINE = 100


def _text_header(description: str, example: str, **schema: object) -> dict[str, Any]:
    return {"description": description, "schema": {"type": "string", **schema}, "example": example}


HEADERS = {
    "X-Request-ID": _text_header(
        "The id sent with the request, or a generated one; it is also in the logs", "0b7c3d3e9a4f4d0c8b1f2a6e5d4c3b2a"
    ),
    "ETag": _text_header(
        "Strong validator of what callers can change; send it back as `If-Match`",
        '"0f8fad5bd9cb469fa16570867728950e"',
    ),
    "Idempotency-Replayed": _text_header(
        "Present if this is the stored answer to an earlier request with the same key", "true", enum=["true"]
    ),
    "Retry-After": {
        "description": "Seconds to wait before retrying",
        "schema": {"type": "string", "pattern": "^[0-9]+$"},
        "example": "1",
    },
    "WWW-Authenticate": _text_header("Authentication scheme", 'Bearer realm="tidegate"'),
    "Link": _text_header(
        "RFC 8288: link to the next page; absent on the last page", '</api/v1/sessions?cursor=abc&limit=50>; rel="next"'
    ),
    "Location": _text_header("URL of the created resource", "/api/v1/sessions/0f8fad5bd9cb469fa16570867728950e"),
}


def header(name: str) -> dict[str, Any]:
    """Return the reference to a shared header."""
    return {"$ref": f"#/components/headers/{name}"}


def shared_response(name: str) -> dict[str, Any]:
    """Return the reference to a shared answer."""
    return {"$ref": f"#/components/responses/{name}"}


def _problem(description: str, *headers: str) -> dict[str, Any]:
    names = ("X-Request-ID", *headers)
    return {"description": description, "content": PROBLEM_CONTENT, "headers": {name: header(name) for name in names}}


RESPONSES = {
    "Problem": _problem("A problem (RFC 9457); `x-problem-codes` of the call has its codes by status"),
    "ProblemForNow": _problem("A problem that may pass: repeat the call later", "Retry-After"),
    "NotLoggedIn": _problem("Not logged in, or the log-in has expired", "WWW-Authenticate"),
}


def complete_operation(operation: Operation, method: str, path: str) -> None:
    """Add request body, problems and headers of the answers to an operation."""
    needs = RULES.get((method, path))
    if method in CHANGES:
        is_obeyed = (method, path) in TAKES_PERMISSION_AWAY
        operation.setdefault("requestBody", WHO_ASKS if is_obeyed else NOTHING_TO_SAY)
    _describe_access(operation, needs)
    responses = operation["responses"]
    if _is_made_by_fastapi(responses.get("422")):
        del responses["422"]
    for status, codes in _codes(operation, method, path, needs).items():
        _add_problem(responses, status, codes)
    operation[CODES] = {}
    for status, answer in sorted(responses.items()):
        responses[status] = _completed_answer(operation, status, answer)
    if IF_NONE_MATCH in _parameters(operation):
        responses["304"] = {"description": "The ETag matches `If-None-Match`", "headers": _headers(operation, "304")}
    operation["responses"] = dict(sorted(responses.items()))


def _describe_access(operation: Operation, needs: Needs | None) -> None:
    if needs is Open.PUBLIC:
        operation["security"] = []
        return
    is_permission = needs is not None and not isinstance(needs, Open)
    operation["security"] = [{name: []} for name in SECURITY_SCHEMES]
    operation["x-permission"] = str(needs) if is_permission else None


def _codes(operation: Operation, method: str, path: str, needs: Needs | None) -> Codes:
    """Return the problem codes, by status, that this call can have."""
    found: Codes = {421: {"host_refused"}, 500: {"internal_error"}}
    for codes in (_of_access(method, path, needs), _of_body(operation, method, path), _of_parameters(operation)):
        for status, more in codes.items():
            found.setdefault(status, set()).update(more)
    if path.startswith(V1) and not _is_page(operation):
        found.setdefault(422, set()).add("invalid_value")  # an unknown parameter
        found[503] = {"storage_unavailable"}
        if (method, path) not in TAKES_PERMISSION_AWAY:
            found[406] = {"not_acceptable"}
    return found


def _of_access(method: str, path: str, needs: Needs | None) -> Codes:
    codes: Codes = {}
    if method in CHANGES:
        codes[403] = {"origin_refused"}
    if needs is Open.PUBLIC:
        return codes
    codes[401] = {"not_logged_in"}
    if (method, path) not in BEFORE_THE_PASSWORD_IS_CHANGED:
        codes.setdefault(403, set()).add("password_change_due")
    if not isinstance(needs, Open):
        codes.setdefault(403, set()).add("permission_missing")
    return codes


def _of_body(operation: Operation, method: str, path: str) -> Codes:
    if method not in CHANGES:
        return {}
    if (method, path) in TAKES_PERMISSION_AWAY:  # done whatever becomes of its body, unless it is no HTTP
        return {400: {"bad_request"}}
    codes: Codes = {408: {"request_timeout"}, 413: {"body_too_large"}, 415: {"media_type"}}
    if "requestBody" in operation:
        codes[400] = {"bad_request"}
        codes[422] = {"invalid_value"}
    return codes


def _of_parameters(operation: Operation) -> Codes:
    names = _parameters(operation)
    codes: Codes = {}
    if IDEMPOTENCY_KEY in names:
        codes[409] = {"idempotency_key_reused", "idempotency_in_progress"}
    if IF_MATCH in names:
        codes[412] = {"precondition_failed"}
    if names:
        codes[422] = {"invalid_value"}
    return codes


def _add_problem(responses: Operation, status: int, codes: set[str]) -> None:
    known = responses.get(str(status), {})
    if SHOWN_TO_PEOPLE in known.get("content", {}):
        return
    responses[str(status)] = {**known, **problem_answer(status, codes | set(known.get(CODES, ())))}


def _completed_answer(operation: Operation, status: str, answer: Operation) -> Operation:
    """Return an answer with its headers; of a problem a reference, with its codes in the operation."""
    codes = answer.get(CODES, [])
    if not codes:
        return {**answer, "headers": answer.get("headers", {}) | _headers(operation, status)}
    operation[CODES][status] = codes
    if status == "401":
        return shared_response("NotLoggedIn")
    return shared_response("ProblemForNow" if WITH_RETRY & set(codes) else "Problem")


def _headers(operation: Operation, status: str) -> Operation:
    """Return the headers that an answer can have."""
    names = _parameters(operation)
    found = ["X-Request-ID"]
    if {IF_MATCH, IF_NONE_MATCH} & names and status[0] in "23":
        found.append("ETag")
    if IDEMPOTENCY_KEY in names and status[0] == "2":
        found.append("Idempotency-Replayed")
    if "cursor" in names and status == "200":
        found.append("Link")
    return {name: header(name) for name in found}


def _parameters(operation: Operation) -> set[str]:
    return {parameter["name"].lower() for parameter in operation.get("parameters", ())}


def _is_made_by_fastapi(answer: Operation | None) -> bool:
    return answer is not None and "HTTPValidationError" in str(answer.get("content", ""))


def _is_page(operation: Operation) -> bool:
    return any(SHOWN_TO_PEOPLE in answer.get("content", {}) for answer in operation["responses"].values())


def contract_files(app: FastAPI) -> dict[str, str]:
    """Return the text of each contract file, by name."""
    return {
        OPENAPI_NAME: _text(app.openapi()),
        LIVE_NAME: _schema(live_messages.LIVE_MESSAGE, live_messages.SCHEMA),
        COACH_NAME: _schema(coaching.COACH_MESSAGE, coaching.SCHEMA),
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
