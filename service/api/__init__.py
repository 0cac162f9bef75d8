"""The REST interface under /api/v1, one router a resource: routers ask a port and answer, errors have a table."""

from typing import Any

PROBLEM_CONTENT = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
MEANING = {
    401: "Nobody is logged in, or the log-in is over",
    403: "Whoever asks may not, or another page asks",
    404: "There is no such thing",
    409: "Not in this state",
    413: "The body is too large",
    415: "The body is not JSON",
    429: "Too many log-ins have failed",
    422: "A value is out of its bound",
    503: "The engine or the database does not answer",
}


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Document the problems a route may answer with."""
    return {status: {"description": MEANING[status], "content": PROBLEM_CONTENT} for status in statuses}
