"""Pages of lists: a cursor is opaque, belongs to one list with its filters, and says when it was tampered with.

What follows is told twice: as `next_cursor`, and as ``Link: <...>; rel="next"`` (RFC 8288). A page goes on behind the
last row of the one before, so that nothing is told twice or left out when rows are added meanwhile.
"""

import base64
import binascii
import hashlib
from typing import TypeVar
from urllib.parse import urlencode

from fastapi import Request, Response
from pydantic import BaseModel

from service.errors import BoundError

SEAL_BYTES = 6
LONGEST = 200
NO_FILTERS = frozenset({"cursor", "limit"})


PageT = TypeVar("PageT", bound=BaseModel)


class Paging:
    """Where a page begins, how much is on it, and what is told of the next."""

    def __init__(self, request: Request, response: Response, cursor: str | None, limit: int) -> None:
        self._request = request
        self._response = response
        self._filters = sorted((name, text) for name, text in request.query_params.items() if name not in NO_FILTERS)
        self.limit = limit
        self.cursor = None if cursor is None else self._opened(cursor)

    def told(self, page: PageT) -> PageT:
        """Return the page with its next cursor as it is told, and the link to it."""
        place = getattr(page, "next_cursor", None)
        if place is None:
            return page
        cursor = self._sealed(place)
        query = urlencode([*self._filters, ("cursor", cursor), ("limit", str(self.limit))])
        self._response.headers["Link"] = f'<{self._request.url.path}?{query}>; rel="next"'
        return page.model_copy(update={"next_cursor": cursor})

    def _sealed(self, place: str) -> str:
        return base64.urlsafe_b64encode(self._seal(place) + place.encode()).decode().rstrip("=")

    def _opened(self, cursor: str) -> str:
        try:
            content = base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4))
            place = content[SEAL_BYTES:].decode()
        except (ValueError, binascii.Error) as error:
            raise _cursor_error(cursor) from error
        if content[:SEAL_BYTES] != self._seal(place) or self._sealed(place) != cursor:
            raise _cursor_error(cursor)
        return place

    def _seal(self, place: str) -> bytes:
        """Bind a place to its list and its filters: behind another question it would leave rows out."""
        text = repr((self._request.url.path, self._filters, place))
        return hashlib.sha256(text.encode("utf-8", "backslashreplace")).digest()[:SEAL_BYTES]


def _cursor_error(cursor: str) -> BoundError:
    bound = "a next_cursor of this list, asked for with the same filters"
    return BoundError(f"cursor must be {bound}", field="cursor", value=cursor, bound=bound)
