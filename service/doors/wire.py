"""HTTP/1.1 as it is written, and in no other way: what two readers could read differently is refused.

h11 is forgiving where RFC 9112 lets it be (bare line feeds, folded headers, a Transfer-Encoding beside a
Content-Length); a proxy in front may be forgiving in another way, and then the two do not agree where a request ends.
"""

import re

import h11

from service.doors.limits import DoorLimits

BAD_REQUEST, URL_TOO_LONG, HEADERS_TOO_LARGE = 400, 414, 431
_END = b"\r\n\r\n"
_BARE = re.compile(rb"(?<!\r)\n|\r(?!\n|\Z)|\0")
_FOLDED = re.compile(rb"\r\n[ \t]")
_TOKEN = re.compile(rb"[!#$%&'*+.^_`|~0-9A-Za-z-]{1,20}")


class StrictConnection(h11.Connection):
    """An h11 connection of a server that checks what h11 lets pass."""

    def __init__(self, limits: DoorLimits) -> None:
        super().__init__(h11.SERVER, limits.max_header_bytes)
        self._limits = limits

    def next_event(self) -> h11.Event | type[h11.NEED_DATA] | type[h11.PAUSED]:
        """Return what came next; raise RemoteProtocolError with the status that is answered."""
        if self.their_state is h11.IDLE and self.our_state is h11.IDLE:
            self._check_head(self.trailing_data[0])
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._check_request(event)
        return event

    def _check_head(self, waiting: bytes) -> None:
        """Look at the bytes of a request's head, as far as they are here."""
        head, end, _ = waiting.partition(_END)
        if not end and len(head) > self._limits.max_header_bytes:
            line = head.partition(b"\r\n")[0]
            is_url = len(line) > self._limits.max_url_bytes
            raise _refusal("the URL", URL_TOO_LONG) if is_url else _refusal("the headers", HEADERS_TOO_LARGE)
        if _BARE.search(head):
            raise _refusal("a line that does not end as HTTP's do", BAD_REQUEST)
        if _FOLDED.search(head):
            raise _refusal("a folded header", BAD_REQUEST)

    def _check_request(self, request: h11.Request) -> None:
        names = [name for name, _ in request.headers]
        if len(request.target) > self._limits.max_url_bytes:
            raise _refusal("the URL", URL_TOO_LONG)
        head_bytes = sum(len(name) + len(value) + 4 for name, value in request.headers) + len(request.target)
        if len(names) > self._limits.max_headers or head_bytes > self._limits.max_header_bytes:
            raise _refusal("the headers", HEADERS_TOO_LARGE)
        if not request.target.startswith(b"/"):
            raise _refusal("a target that is no path", BAD_REQUEST)
        if b"transfer-encoding" in names and (b"content-length" in names or request.http_version != b"1.1"):
            raise _refusal("two ways to say where the body ends", BAD_REQUEST)
        if not _TOKEN.fullmatch(request.method):
            raise _refusal("the method", BAD_REQUEST)


def _refusal(what: str, status: int) -> h11.RemoteProtocolError:
    return h11.RemoteProtocolError(what, error_status_hint=status)
