"""Conditional requests (RFC 9110, section 13): ETags, ``If-Match`` and ``If-None-Match``.

An ETag covers what callers can change. Values that change by themselves (the frame count of a running session, the
time of a key's last use) are left out; with them no precondition would ever match.
"""

import hashlib
import json
import re
from dataclasses import dataclass

from service.core.errors import BoundError, PreconditionFailedError

IF_MATCH = "If-Match"
IF_NONE_MATCH = "If-None-Match"
LONGEST = 1_000
ANY = "*"
_TAG = r'(?:W/)?"[\x21\x23-\x7e]*"'
_LIST = re.compile(rf"\s*{_TAG}(?:\s*,\s*{_TAG})*\s*")
_ONE = re.compile(_TAG)


def etag_of(*parts: object) -> str:
    """Return the strong ETag of the parts; each part is JSON-serialisable or has a stable `str()`."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=str)
    return f'"{hashlib.sha256(text.encode()).hexdigest()[:32]}"'


@dataclass(frozen=True, slots=True, kw_only=True)
class Precondition:
    """The parsed ``If-Match`` header; `tags` is None without one, and then every state matches."""

    tags: frozenset[str] | None = None

    @property
    def is_given(self) -> bool:
        """Whether the request has ``If-Match``."""
        return self.tags is not None

    @property
    def names_a_state(self) -> bool:
        """Whether only some states match: the request has ``If-Match``, and not ``*``."""
        return self.tags is not None and ANY not in self.tags

    def require(self, etag: str) -> None:
        """Raise PreconditionFailedError if the header names other ETags than `etag`.

        A weak tag never matches (RFC 9110, 13.1.1).
        """
        if self.tags is None or ANY in self.tags or etag in self.tags:
            return
        msg = "The resource was changed. Read it again and check the changes before you repeat the call."
        given = ", ".join(sorted(self.tags))
        raise PreconditionFailedError(msg, field=IF_MATCH, value=given, bound=etag)


ANYTHING = Precondition()


def precondition(header: str | None) -> Precondition:
    """Parse ``If-Match``; raise BoundError if it is not a list of ETags."""
    return Precondition(tags=None if header is None else _tags(header, IF_MATCH))


def is_known(header: str | None, etag: str) -> bool:
    """Whether ``If-None-Match`` names the present ETag, so that the answer is 304."""
    if header is None:
        return False
    tags = _tags(header, IF_NONE_MATCH)
    return ANY in tags or etag in {tag.removeprefix("W/") for tag in tags}


def _tags(header: str, name: str) -> frozenset[str]:
    if header.strip() == ANY:
        return frozenset({ANY})
    if _LIST.fullmatch(header) is None:
        bound = '"..." as in an ETag header, several separated by commas, or *'
        raise BoundError(f"{name} must be {bound}", field=name, value=header, bound=bound)
    return frozenset(_ONE.findall(header))
