"""What is answered to a connection that does not keep to the protocol, and how the log hears of it: as numbers.

One line at most every ten seconds, with codes and counts; never an address, never a byte of what was sent.
"""

import logging
from collections import Counter
from collections.abc import Callable
from http import HTTPStatus

from starlette.exceptions import HTTPException

from service.middleware import SECURITY_HEADERS
from service.problems import MEDIA_TYPE, problem_of

logger = logging.getLogger(__name__)
TELL_EVERY_S = 10.0


class RefusalCount:
    """Counts what was refused, and tells of it now and then; for one thread."""

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s = now_s
        self._waiting: Counter[str] = Counter()
        self._told_s: float | None = None
        self.total: Counter[str] = Counter()

    def add(self, what: str) -> None:
        """Count one."""
        self.total[what] += 1
        self._waiting[what] += 1
        self.tell()

    def tell(self) -> None:
        """Tell what waits, unless it was told just now."""
        now_s = self._now_s()
        if not self._waiting or (self._told_s is not None and now_s < self._told_s + TELL_EVERY_S):
            return
        self._told_s = now_s
        logger.warning("refused at the door: %s", ", ".join(f"{n} {what}" for what, n in sorted(self._waiting.items())))
        self._waiting.clear()


def problem_answer(status: int, detail: str) -> tuple[str, list[tuple[bytes, bytes]], bytes]:
    """Return code, headers and body of a refusal that ends its connection."""
    problem = problem_of(HTTPException(status, detail))
    body = problem.model_dump_json(exclude_none=True).encode()
    told = {
        **SECURITY_HEADERS,
        "Content-Type": MEDIA_TYPE,
        "Content-Length": str(len(body)),
        "Cache-Control": "no-cache",
        "Connection": "close",
    }
    return problem.code, [(name.lower().encode(), value.encode()) for name, value in told.items()], body


def phrase_of(status: int) -> bytes:
    """Return what HTTP calls a status."""
    return HTTPStatus(status).phrase.encode()
