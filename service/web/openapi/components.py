"""Shared parts of the operations: authentication, headers, tags, the answers of problems."""

from typing import Any

from service.access.login.cookies import PLAIN_NAME
from service.web.api import PROBLEM_CONTENT

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
