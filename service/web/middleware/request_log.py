"""The request log: every request gets an id, is timed and counted, and produces one log line.

Unhandled errors are answered here, so that their answers have the same id and headers as all others; the exception is
raised again for the web server, which logs its location.

The outermost middleware: stamps the time at which a request arrived, see `service.core.current_request`.
"""

import logging
import time
from typing import cast

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.access.request.identity import identity_in
from service.access.request.rules import SOCKET
from service.core.current_request import HEADER, arriving_now, begin_request, request_id_of
from service.core.logging.redaction import FIELDS
from service.monitoring.metrics.registry import HttpCounters, RouteNames, method_of
from service.web.middleware.requests import SECURITY_HEADERS
from service.web.problems.table import problem_of, problem_response

logger = logging.getLogger(__name__)

QUIET = frozenset({"/healthz", "/readyz", "/metrics"})
"""Polled by machines; logged only if they fail."""
CLIENT_LEFT = 499
SWITCHED = 101
REFUSED_SOCKET = 403
FAILED = 500


class _Answer:
    """One request and its result."""

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
        """Record the status and size of the answer, and add the id to its headers."""
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
        """Write the log line; it has the kind of caller only, names are in the protected audit log."""
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
        message = "%(method)s %(route)s %(status)d %(duration_ms).1f ms %(bytes)d bytes %(caller)s"
        logger.info(message, fields, extra={FIELDS: fields})

    def _caller(self) -> str:
        identity = identity_in(self.scope)
        if identity is None:
            return "nobody"
        return "person" if identity.is_person else "machine"


class RequestLog:
    """Assigns ids to requests, times and counts them."""

    def __init__(self, app: ASGIApp, page_files: frozenset[str]) -> None:
        self._app = app
        self._routes = RouteNames(page_files)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Process one request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        given = [value for name, value in scope["headers"] if name == HEADER.encode()]
        request_id = request_id_of(given)
        begin_request(request_id, scope["path"])
        answer = _Answer(scope, request_id, self._routes.of(scope["path"]))
        tallies = cast("HttpCounters | None", getattr(scope["app"].state, "http_tallies", None))
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


class Arrival:
    """Stamps each HTTP request before it can wait; the route's thread inherits the context."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Stamp an HTTP request and pass it on; pass everything else on as it is."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        with arriving_now():
            await self._app(scope, receive, send)
