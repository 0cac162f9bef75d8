"""Answers to connections that violate the protocol, and their counts in the log.

At most one log line every ten seconds, with codes and counts; never an address or a byte that was sent.

Aborts a connection and discards its buffers, including the kernel's.
"""

import contextlib
import logging
import socket
import struct
from asyncio import Transport
from collections import Counter
from collections.abc import Callable
from http import HTTPStatus

from starlette.exceptions import HTTPException

from service.web.middleware.requests import SECURITY_HEADERS
from service.web.problems.table import MEDIA_TYPE, problem_of

logger = logging.getLogger(__name__)
LOG_PERIOD_S = 10.0
_NO_LINGER = struct.pack("ii", 1, 0)


class RefusalCount:
    """Counts refusals and logs them at intervals; for one thread."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._waiting: Counter[str] = Counter()
        self._logged_s: float | None = None
        self.total: Counter[str] = Counter()

    def add(self, what: str) -> None:
        """Count a refusal by its code."""
        self.total[what] += 1
        self._waiting[what] += 1
        self.log_counts()

    def log_counts(self) -> None:
        """Log the counts, unless they were logged within the interval."""
        now_s = self._now_s()
        if not self._waiting or (self._logged_s is not None and now_s < self._logged_s + LOG_PERIOD_S):
            return
        self._logged_s = now_s
        logger.warning("connections refused: %s", ", ".join(f"{n} {what}" for what, n in sorted(self._waiting.items())))
        self._waiting.clear()


def problem_answer(status: int, detail: str) -> tuple[str, list[tuple[bytes, bytes]], bytes]:
    """Return code, headers and body of the answer to a refused connection."""
    problem = problem_of(HTTPException(status, detail))
    body = problem.model_dump_json(exclude_none=True).encode()
    headers = {
        **SECURITY_HEADERS,
        "Content-Type": MEDIA_TYPE,
        "Content-Length": str(len(body)),
        "Cache-Control": "no-cache",
        "Connection": "close",
    }
    return problem.code, [(name.lower().encode(), value.encode()) for name, value in headers.items()], body


def phrase_of(status: int) -> bytes:
    """Return the reason phrase of an HTTP status."""
    return HTTPStatus(status).phrase.encode()


def abort(transport: Transport) -> None:
    """Abort a connection and discard unsent data; a plain close would keep sending to a client that does not read."""
    try:
        raw = transport.get_extra_info("socket")
    except AttributeError:
        # asyncio's TLS transport drops its connection when closed a second time, as uvicorn does: nothing can be
        # aborted through it any more, and the TLS shutdown's own timeout ends the connection.
        return
    if raw is not None:
        with contextlib.suppress(OSError):
            raw.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _NO_LINGER)
    transport.abort()
