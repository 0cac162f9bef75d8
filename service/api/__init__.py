"""The REST interface under /api/v1, one router a resource: routers ask a port and answer, errors have a table."""

from typing import Any

from service.problems import HTTP_CODES, code_of, status_of

PROBLEM_CONTENT = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
CODES = "x-problem-codes"
"""Where a documented answer lists the codes of its problems."""
MEANING = {
    400: "It cannot be read",
    401: "Nobody is logged in, or the log-in is over",
    403: "Whoever asks may not, or another page asks",
    404: "There is no such thing",
    406: "The answer has no such media type",
    408: "It took too long to come",
    409: "Not in this state",
    412: "It was changed since",
    413: "The body is too large",
    415: "The body is of another media type",
    421: "This name is not served here",
    422: "A value is out of its bound",
    429: "Too many log-ins have failed",
    500: "Tidegate failed",
    503: "The engine, the camera or the database does not answer",
    507: "There is no room for another session",
}
USUAL_CODES = {**HTTP_CODES, 422: "invalid_value", 500: "internal_error", 503: "storage_unavailable"}


def problems(*kinds: type[Exception] | int) -> dict[int | str, dict[str, Any]]:
    """Document the problems a route may answer with, by the errors that it lets through.

    What any call may meet (nobody logged in, a body too large, the database away) is added by `service.openapi`. A bare
    status stands for its usual code.
    """
    codes: dict[int, set[str]] = {}
    for kind in kinds:
        status = kind if isinstance(kind, int) else status_of(kind)
        usual = {USUAL_CODES[status]} if status in USUAL_CODES else set()
        codes.setdefault(status, set()).update(usual if isinstance(kind, int) else {code_of(kind)})
    return {status: problem_answer(status, found) for status, found in sorted(codes.items())}


def problem_answer(status: int, codes: set[str]) -> dict[str, Any]:
    """Document one status with the codes that it may have."""
    return {"description": MEANING[status], "content": PROBLEM_CONTENT, CODES: sorted(codes)}
