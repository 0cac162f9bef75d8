"""Completes every operation: request body, access, problems, headers of the answers.

Everything is derived from the operation and the table of access rules; a router declares only its specific problems.
"""

from typing import Any

from service.access.request.rules import BEFORE_THE_PASSWORD_IS_CHANGED, RULES, TAKES_PERMISSION_AWAY, Needs, Open
from service.core.conditional import IF_MATCH as IF_MATCH_HEADER
from service.core.conditional import IF_NONE_MATCH as IF_NONE_MATCH_HEADER
from service.storage.database.idempotency import HEADER as IDEMPOTENCY_HEADER
from service.web.api import CODES, problem_answer
from service.web.openapi.components import SECURITY_SCHEMES, header, shared_response

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
