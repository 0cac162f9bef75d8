"""The REST interface under /api/v1: one router per resource; errors are mapped by `service.web.problems`."""

from typing import Any

from service.web.problems.table import HTTP_CODES, code_of, status_of

PROBLEM_CONTENT = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
CODES = "x-problem-codes"
"""Extension key of a documented answer that lists the codes of its problems."""
MEANING = {
    400: "The body cannot be parsed",
    401: "Not logged in, or the log-in has expired",
    403: "Permission missing, or the call comes from another origin",
    404: "Not found",
    406: "Media type not available",
    408: "The request took too long",
    409: "Not allowed in the present state",
    412: "The resource was changed",
    413: "The body is too large",
    415: "Media type of the body not supported",
    421: "This host name is not served",
    422: "A value is outside its bound",
    429: "Too many failed log-ins",
    500: "Internal error",
    503: "The engine, the camera or the database does not answer",
    507: "Not enough disk space for another session",
}
USUAL_CODES = {**HTTP_CODES, 422: "invalid_value", 500: "internal_error", 503: "storage_unavailable"}


def problems(*kinds: type[Exception] | int) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI responses for the errors that a route may raise.

    `service.web.openapi` adds the problems that any call can have (not logged in, body too large, database down).
    A bare status stands for its usual code.
    """
    codes: dict[int, set[str]] = {}
    for kind in kinds:
        status = kind if isinstance(kind, int) else status_of(kind)
        usual = {USUAL_CODES[status]} if status in USUAL_CODES else set()
        codes.setdefault(status, set()).update(usual if isinstance(kind, int) else {code_of(kind)})
    return {status: problem_answer(status, found) for status, found in sorted(codes.items())}


def problem_answer(status: int, codes: set[str]) -> dict[str, Any]:
    """Return the OpenAPI response of one status, with its problem codes."""
    return {"description": MEANING[status], "content": PROBLEM_CONTENT, CODES: sorted(codes)}
