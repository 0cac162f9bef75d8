"""The outermost layer: every request gets an id, is timed and counted, and leaves one line in the log.

What nobody caught inside is answered here, so that such an answer, too, has its id and the headers of all others; the
web server is told of the failure all the same, and logs where it was.
"""

import logging
import time
from typing import cast

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.access.identity import identity_in
from service.access.rules import SOCKET
from service.http_tallies import HttpTallies, RouteNames, method_of
from service.middleware import SECURITY_HEADERS
from service.private_log import FIELDS
from service.problems import problem_of, problem_response
from service.request_ids import HEADER, begin_request, request_id_of

logger = logging.getLogger(__name__)

QUIET = frozenset({"/healthz", "/readyz", "/metrics"})
"""Asked again and again by machines; in the log only where they fail."""
CLIENT_LEFT = 499
SWITCHED = 101
REFUSED_SOCKET = 403
FAILED = 500


class _Answer:
    """One request on its way, and what became of it."""

    def __init__(self, scope: Scope, request_id: str, route: str) -> None:
        self.scope = scope
        self.request_id = request_id
        self.method = method_of(scope["type"], scope.get("method", ""))
        self.route = route
        self.status = 0
        self.sent_bytes = 0
        self._began_s = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._began_s

    def note(self, message: Message) -> None:
        """Look at what is sent, and put the id on its head."""
        match message["type"]:
            case "http.response.start" | "websocket.accept" | "websocket.http.response.start":
                self.status = message.get("status", SWITCHED)
                message.setdefault("headers", [])
                MutableHeaders(scope=message)[HEADER] = self.request_id
            case "http.response.body" | "websocket.http.response.body":
                self.sent_bytes += len(message.get("body", b""))
            case "websocket.close" if self.status == 0:
                self.status = REFUSED_SOCKET

    def line(self) -> None:
        """Leave the line; who called is told by kind alone: names are the audit's, which is kept and protected."""
        if self.route in QUIET and self.status < FAILED:
            return
        fields = {
            "method": self.method,
            "route": self.route,
            "status": self.status,
            "duration_ms": round(1000.0 * self.seconds, 1),
            "bytes": self.sent_bytes,
            "caller": self._caller(),
        }
        told = "%(method)s %(route)s %(status)d %(duration_ms).1f ms %(bytes)d bytes %(caller)s"
        logger.info(told, fields, extra={FIELDS: fields})

    def _caller(self) -> str:
        identity = identity_in(self.scope)
        if identity is None:
            return "nobody"
        return "person" if identity.is_person else "machine"


class RequestWatch:
    """Names, times and counts whatever comes in."""

    def __init__(self, app: ASGIApp, page_files: frozenset[str]) -> None:
        self._app = app
        self._routes = RouteNames(page_files)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Watch one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        given = [value for name, value in scope["headers"] if name == HEADER.encode()]
        request_id = request_id_of(given)
        begin_request(request_id, scope["path"])
        answer = _Answer(scope, request_id, self._routes.of(scope["path"]))
        tallies = cast("HttpTallies | None", getattr(scope["app"].state, "http_tallies", None))
        if tallies is not None:
            tallies.begin(answer.method)
        try:
            await self._watched(answer, receive, send)
        finally:
            answer.status = answer.status or CLIENT_LEFT
            if tallies is not None:
                tallies.end(answer.method, answer.route, answer.status, answer.seconds)
            answer.line()

    async def _watched(self, answer: _Answer, receive: Receive, send: Send) -> None:
        async def send_noted(message: Message) -> None:
            answer.note(message)
            await send(message)

        try:
            await self._app(answer.scope, receive, send_noted)
        except Exception as error:
            if answer.method != SOCKET and answer.status == 0:
                await problem_response(problem_of(error), SECURITY_HEADERS)(answer.scope, receive, send_noted)
            raise
