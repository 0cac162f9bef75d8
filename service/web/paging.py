"""Pages of lists: a cursor is opaque, belongs to one list with its filters, and is refused when it was changed.

An answer names the next page twice: as `next_cursor`, and as ``Link: <...>; rel="next"`` (RFC 8288). A page begins
after the last row of the one before, so that no row is repeated or left out when rows are added meanwhile.
"""

import base64
import binascii
import hashlib
from typing import TypeVar
from urllib.parse import urlencode

from fastapi import Request, Response
from pydantic import BaseModel

from service.core.errors import BoundError

SEAL_BYTES = 6
LONGEST = 200
NO_FILTERS = frozenset({"cursor", "limit"})


PageT = TypeVar("PageT", bound=BaseModel)


class Paging:
    """Where a page begins, how many items are on it, and the answer's reference to the next page."""

    def __init__(self, request: Request, response: Response, cursor: str | None, limit: int) -> None:
        self._request = request
        self._response = response
        self._filters = sorted((name, text) for name, text in request.query_params.items() if name not in NO_FILTERS)
        self.limit = limit
        self.cursor = None if cursor is None else self._opened(cursor)

    def answer(self, page: PageT) -> PageT:
        """Return the page with its next cursor sealed, and set the Link header."""
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
        """Bind a cursor to its list and filters; with other filters it would skip rows."""
        text = repr((self._request.url.path, self._filters, place))
        return hashlib.sha256(text.encode("utf-8", "backslashreplace")).digest()[:SEAL_BYTES]


def _cursor_error(cursor: str) -> BoundError:
    bound = "a next_cursor of this list with the same filters"
    return BoundError(f"cursor must be {bound}", field="cursor", value=cursor, bound=bound)
