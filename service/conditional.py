"""Conditional requests (RFC 9110, 13): ETags of what can be decided about a thing, ``If-Match`` and ``If-None-Match``.

An ETag here validates what a person or a machine can change by calling. Figures that change by themselves (a running
session's frames, when a key was last used) are no part of it: otherwise no precondition could ever hold.
"""

import hashlib
import json
import re
from dataclasses import dataclass

from service.errors import BoundError, PreconditionFailedError

IF_MATCH = "If-Match"
IF_NONE_MATCH = "If-None-Match"
LONGEST = 1_000
ANY = "*"
_TAG = r'(?:W/)?"[\x21\x23-\x7e]*"'
_LIST = re.compile(rf"\s*{_TAG}(?:\s*,\s*{_TAG})*\s*")
_ONE = re.compile(_TAG)


def etag_of(*parts: object) -> str:
    """Return the strong ETag of what these say; the parts are whatever JSON can tell, or has a text of its own."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=str)
    return f'"{hashlib.sha256(text.encode()).hexdigest()[:32]}"'


@dataclass(frozen=True, slots=True, kw_only=True)
class Precondition:
    """What ``If-Match`` asks for; without one everything is as it should be."""

    tags: frozenset[str] | None = None

    @property
    def is_given(self) -> bool:
        """Whether anything is asked for."""
        return self.tags is not None

    def require(self, etag: str) -> None:
        """Raise PreconditionFailedError where the present state is another one.

        A weak tag never matches: it does not say that nothing was changed.
        """
        if self.tags is None or ANY in self.tags or etag in self.tags:
            return
        msg = "it was changed since: read it again, look at what changed, and decide anew"
        given = ", ".join(sorted(self.tags))
        raise PreconditionFailedError(msg, field=IF_MATCH, value=given, bound=etag)


ANYTHING = Precondition()


def precondition(header: str | None) -> Precondition:
    """Read ``If-Match``."""
    return Precondition(tags=None if header is None else _tags(header, IF_MATCH))


def is_known(header: str | None, etag: str) -> bool:
    """Whether ``If-None-Match`` names the present state: then there is nothing to tell."""
    if header is None:
        return False
    tags = _tags(header, IF_NONE_MATCH)
    return ANY in tags or etag in {tag.removeprefix("W/") for tag in tags}


def _tags(header: str, name: str) -> frozenset[str]:
    if header.strip() == ANY:
        return frozenset({ANY})
    if _LIST.fullmatch(header) is None:
        bound = '"..." as an ETag told it, several parted by commas, or *'
        raise BoundError(f"{name} must be {bound}", field=name, value=header, bound=bound)
    return frozenset(_ONE.findall(header))
