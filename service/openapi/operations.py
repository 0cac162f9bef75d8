"""What every operation is completed with: what it takes, what it may be refused with, the headers of its answers.

All of it is worked out from the operation itself and the table of rules; a router names only what is its own.
"""

from copy import deepcopy
from typing import Any

from service.access.rules import BEFORE_THE_PASSWORD_IS_CHANGED, RULES, TAKES_PERMISSION_AWAY, Needs, Open
from service.api import CODES, problem_answer
from service.conditional import IF_MATCH as IF_MATCH_HEADER
from service.conditional import IF_NONE_MATCH as IF_NONE_MATCH_HEADER
from service.deprecation import DEPRECATED
from service.idempotency import HEADER as IDEMPOTENCY_HEADER
from service.openapi.components import SECURITY_SCHEMES, header
from service.problem_catalogue import CATALOGUE

Operation = dict[str, Any]
Codes = dict[int, set[str]]
IF_MATCH, IF_NONE_MATCH, IDEMPOTENCY_KEY = (
    name.lower() for name in (IF_MATCH_HEADER, IF_NONE_MATCH_HEADER, IDEMPOTENCY_HEADER)
)
"""Names of headers are the same in any case, and FastAPI writes small letters."""
CHANGES = frozenset({"POST", "PUT", "PATCH", "DELETE"})
NOTHING_TO_SAY = {
    "required": True,
    "description": "Nothing of it is read; that its type is JSON keeps foreign pages' forms out",
    "content": {"application/json": {"schema": {}, "example": {}}},
}
WHO_ASKS = {
    "required": False,
    "description": "`operator` as in other calls: whoever is logged in, and may be left out; from a machine, for whom "
    "it acts. What takes permission away is not refused for what it is sent: without a body, with one that has other "
    "fields, is of another type, is no JSON or does not come whole, it is done all the same. Of a "
    "machine's call the audit says what was not read; a person's name is the log-in's, and the body is not waited for",
    "content": {"application/json": {"schema": {}, "example": {"operator": "A. Therapist"}}},
}
V1 = "/api/v1/"
SHOWN_TO_PEOPLE = "text/html"
WITH_RETRY = frozenset({"idempotency_in_progress", "locked_out", "login_busy", "plan_busy", "stream_full"})


def complete_operation(operation: Operation, method: str, path: str) -> None:
    """Add what the call takes, all its problems, and the headers of its answers."""
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
    for status, answer in responses.items():
        _complete_answer(operation, status, answer)
    if IF_NONE_MATCH in _parameters(operation):
        responses["304"] = {"description": "It is what `If-None-Match` names", "headers": _headers(operation, "304")}
    _deprecate(operation, (method, path))
    operation["responses"] = dict(sorted(responses.items()))


def _describe_access(operation: Operation, needs: Needs | None) -> None:
    if needs is Open.PUBLIC:
        operation["security"] = []
        return
    is_permission = needs is not None and not isinstance(needs, Open)
    operation["security"] = [{name: []} for name in SECURITY_SCHEMES]
    operation["x-permission"] = str(needs) if is_permission else None


def _codes(operation: Operation, method: str, path: str, needs: Needs | None) -> Codes:
    """Work out the problems that this call may meet whatever it does."""
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


def _complete_answer(operation: Operation, status: str, answer: Operation) -> None:
    """Write down an answer's headers; a problem's codes with what each means, and an example of each."""
    answer["headers"] = answer.get("headers", {}) | _headers(operation, status)
    codes = answer.get(CODES, [])
    if not codes:
        return
    answer["description"] = "\n".join(f"- `{code}`: {CATALOGUE[code].title}" for code in codes)
    answer["content"] = deepcopy(answer["content"])
    examples = {code: {"$ref": f"#/components/examples/{code}"} for code in codes}
    answer["content"]["application/problem+json"]["examples"] = examples
    if WITH_RETRY & set(codes):
        answer["headers"]["Retry-After"] = header("Retry-After")
    if status == "401":
        answer["headers"]["WWW-Authenticate"] = header("WWW-Authenticate")


def _headers(operation: Operation, status: str) -> Operation:
    """Return the headers that an answer may have by what the call takes."""
    names = _parameters(operation)
    found = ["X-Request-ID"]
    if {IF_MATCH, IF_NONE_MATCH} & names and status[0] in "23":
        found.append("ETag")
    if IDEMPOTENCY_KEY in names and status[0] == "2":
        found.append("Idempotency-Replayed")
    if "cursor" in names and status == "200":
        found.append("Link")
    return {name: header(name) for name in found}


def _deprecate(operation: Operation, call: tuple[str, str]) -> None:
    if call not in DEPRECATED:
        return
    operation["deprecated"] = True
    for answer in operation["responses"].values():
        answer["headers"] |= {name: header(name) for name in ("Deprecation", "Sunset")}


def _parameters(operation: Operation) -> set[str]:
    return {parameter["name"].lower() for parameter in operation.get("parameters", ())}


def _is_made_by_fastapi(answer: Operation | None) -> bool:
    return answer is not None and "HTTPValidationError" in str(answer.get("content", ""))


def _is_page(operation: Operation) -> bool:
    return any(SHOWN_TO_PEOPLE in answer.get("content", {}) for answer in operation["responses"].values())
