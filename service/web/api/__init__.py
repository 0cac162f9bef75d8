"""The REST interface under /api/v1: one router per resource; errors are mapped by `service.web.problems`."""

from typing import Any

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


def problem_answer(status: int, codes: set[str]) -> dict[str, Any]:
    """Return the OpenAPI response of one status, with its problem codes."""
    return {"description": MEANING[status], "content": PROBLEM_CONTENT, CODES: sorted(codes)}
