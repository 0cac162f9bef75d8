"""The catalogue of problems: every code, when it is returned and what helps.

docs/4-integrate/problems.md is made from it.

Codes, statuses and titles come from the table in `service.core.errors`, "when" from the docstring
of the error's class, what to do from `service.web.problems.remedies`.
"""

import inspect
import sys
from collections.abc import Mapping
from dataclasses import dataclass

from engine.core.errors import TidegateError
from service.web.problems.remedies import WHAT_TO_DO
from service.web.problems.table import HTTP_CODES, STATUS_OF, STORAGE_CODE, code_of, status_of

USUAL = {
    "bad_request": "The body cannot be parsed.",
    "body_too_large": "The body is larger than the site's limit.",
    "request_timeout": "The request or its body did not arrive within the site's time limit.",
    "url_too_long": "Path and query are longer than the site's limit.",
    "headers_too_large": "The headers exceed the site's limit in size or number.",
    "not_implemented": "The Transfer-Encoding of the body is not supported.",
    "method_not_allowed": "The path exists, but not for this method.",
    "host_refused": "The Host header names a host that this service does not serve.",
    "internal_error": "An unexpected error; the answer contains no internals, the service's log does.",
    STORAGE_CODE: "The database does not answer, or is locked for too long.",
    "http_error": "The request violates HTTP.",
}
TITLES = {
    "bad_request": "The body cannot be parsed",
    "body_too_large": "The body is too large",
    "request_timeout": "The request took too long",
    "url_too_long": "The URL is too long",
    "headers_too_large": "The headers are too large",
    "not_implemented": "The Transfer-Encoding is not supported",
    "method_not_allowed": "Method Not Allowed",
    "host_refused": "This host name is not served",
    "internal_error": "Internal error",
}
WITH_FIELD = frozenset({422, 409, 412})


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One code."""

    code: str
    status: int
    title: str
    when: str
    what_to_do: str


def _entries() -> dict[str, Entry]:
    modules = {sys.modules[kind.__module__] for kind in STATUS_OF if issubclass(kind, TidegateError)}
    kinds = {
        kind
        for module in modules
        for _, kind in inspect.getmembers(module, inspect.isclass)
        if issubclass(kind, TidegateError) and any(base in STATUS_OF for base in kind.__mro__)
    }
    entries: dict[str, Entry] = {}
    for kind in sorted(kinds, key=lambda kind: (len(kind.__mro__), kind.__name__)):
        code = code_of(kind)
        title = next(STATUS_OF[base][1] for base in kind.__mro__ if base in STATUS_OF)
        when = (inspect.getdoc(kind) or "").partition("\n")[0]
        entries.setdefault(code, _entry(code, status_of(kind), title, when))
    statuses = {code: status for status, code in HTTP_CODES.items()} | {"internal_error": 500, STORAGE_CODE: 503}
    for code, status in statuses.items():
        title = TITLES.get(code, "The database does not answer")
        entries.setdefault(code, _entry(code, status, title, USUAL.get(code, "")))
    return dict(sorted(entries.items()))


def _entry(code: str, status: int, title: str, when: str) -> Entry:
    return Entry(code=code, status=status, title=title, when=when, what_to_do=WHAT_TO_DO.get(code, ""))


CATALOGUE: Mapping[str, Entry] = _entries()
