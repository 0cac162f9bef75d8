"""Strict HTTP/1.1: requests that two parsers could read differently are refused.

h11 is lenient where RFC 9112 allows it (bare line feeds, folded headers, Transfer-Encoding with Content-Length). A
proxy in front may be lenient in another way, and then both disagree where a request ends (request smuggling).
"""

import re

import h11

from service.core.settings.connection_limits import ConnectionLimits

BAD_REQUEST, URL_TOO_LONG, HEADERS_TOO_LARGE = 400, 414, 431
_END = b"\r\n\r\n"
_BARE = re.compile(rb"(?<!\r)\n|\r(?!\n|\Z)|\0")
_FOLDED = re.compile(rb"\r\n[ \t]")
_TOKEN = re.compile(rb"[!#$%&'*+.^_`|~0-9A-Za-z-]{1,20}")


class StrictConnection(h11.Connection):
    """An h11 server connection with additional checks."""

    def __init__(self, limits: ConnectionLimits) -> None:
        super().__init__(h11.SERVER, limits.max_header_bytes)
        self._limits = limits

    def next_event(self) -> h11.Event | type[h11.NEED_DATA] | type[h11.PAUSED]:
        """Return the next event; raise RemoteProtocolError with the status of the answer."""
        if self.their_state is h11.IDLE and self.our_state is h11.IDLE:
            self._check_head(self.trailing_data[0])
        event = super().next_event()
        if isinstance(event, h11.Request):
            self._check_request(event)
        return event

    def _check_head(self, waiting: bytes) -> None:
        """Check the received bytes of a request's head."""
        head, end, _ = waiting.partition(_END)
        if not end and len(head) > self._limits.max_header_bytes:
            line = head.partition(b"\r\n")[0]
            is_url = len(line) > self._limits.max_url_bytes
            raise _refusal("the URL", URL_TOO_LONG) if is_url else _refusal("the headers", HEADERS_TOO_LARGE)
        if _BARE.search(head):
            raise _refusal("a line that does not end with CR LF", BAD_REQUEST)
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
            raise _refusal("a target that is not a path", BAD_REQUEST)
        if b"transfer-encoding" in names and (b"content-length" in names or request.http_version != b"1.1"):
            raise _refusal("Transfer-Encoding together with Content-Length", BAD_REQUEST)
        if not _TOKEN.fullmatch(request.method):
            raise _refusal("the method", BAD_REQUEST)


def _refusal(what: str, status: int) -> h11.RemoteProtocolError:
    return h11.RemoteProtocolError(what, error_status_hint=status)
