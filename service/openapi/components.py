"""What operations share: how a caller is known, headers of answers, an example of every problem, what the tags mean."""

from typing import Any

from service.access.cookies import PLAIN_NAME
from service.problem_catalogue import CATALOGUE

SECURITY_SCHEMES = {
    "login": {
        "type": "apiKey",
        "in": "cookie",
        "name": PLAIN_NAME,
        "description": "Of a person who has logged in; over TLS the name begins with `__Host-`. Calls that change "
        "something must also carry the page's own Origin",
    },
    "key": {
        "type": "http",
        "scheme": "bearer",
        "description": "Of a machine: an API key `tg_...`, or a token of the site's identity provider",
    },
}
TAGS = [
    {"name": "sessions", "description": "A fraction under the camera: created, started, armed, watched, stopped."},
    {"name": "plans", "description": "Treatment plans taken in from DICOM, and sessions prepared from them."},
    {"name": "models", "description": "What was learned of a patient's motion."},
    {"name": "calibrations", "description": "Camera calibrations; the same content is the same calibration."},
    {"name": "devices", "description": "Cameras that could be used."},
    {"name": "interlocks", "description": "Every reason to hold the beam, with this site's bounds."},
    {"name": "qa", "description": "Quality assurance: runs, reports, trends and what is expected."},
    {"name": "live", "description": "What goes on now, as a stream."},
    {"name": "audit", "description": "The append-only log: read, proved, exported."},
    {"name": "access", "description": "Log-ins, people and keys."},
    {"name": "health", "description": "Whether the process lives and could work, and its metrics."},
]


def _text_header(description: str, example: str, **schema: object) -> dict[str, Any]:
    return {"description": description, "schema": {"type": "string", **schema}, "example": example}


HEADERS = {
    "X-Request-ID": _text_header(
        "The request's own, or one that was made for it; the logs have it too", "0b7c3d3e9a4f4d0c8b1f2a6e5d4c3b2a"
    ),
    "ETag": _text_header(
        "A strong validator of what can be decided about this; send it back as `If-Match`",
        '"0f8fad5bd9cb469fa16570867728950e"',
    ),
    "Idempotency-Replayed": _text_header(
        "There where this is the answer of an earlier request with the same key", "true", enum=["true"]
    ),
    "Retry-After": {
        "description": "Seconds to wait before trying again",
        "schema": {"type": "string", "pattern": "^[0-9]+$"},
        "example": "1",
    },
    "WWW-Authenticate": _text_header("How to say who one is", 'Bearer realm="tidegate"'),
    "Link": _text_header(
        "RFC 8288: where the next page is; missing on the last", '</api/v1/sessions?cursor=abc&limit=50>; rel="next"'
    ),
    "Location": _text_header("Where what was made is found", "/api/v1/sessions/0f8fad5bd9cb469fa16570867728950e"),
    "Deprecation": _text_header("RFC 9745: since when this should not be used any more", "@1795046400"),
    "Sunset": _text_header("RFC 8594: from when on this may be gone", "Tue, 30 Nov 2027 00:00:00 GMT"),
}


def header(name: str) -> dict[str, Any]:
    """Refer to a shared header."""
    return {"$ref": f"#/components/headers/{name}"}


def problem_examples() -> dict[str, Any]:
    """Return an example of each problem, under its code."""
    return {code: {"summary": entry.title, "value": entry.example} for code, entry in CATALOGUE.items()}
