"""What every request passes: the host's name, a bound on the body, and headers that keep the page to itself."""

from collections.abc import Mapping
from typing import Any

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.access.identity import RULE
from service.deprecation import DEPRECATED
from service.errors import problem_of, problem_response

SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}


class RefusedError(HTTPException):
    """A request refused at the door; carries field, value and bound for the problem."""

    def __init__(self, status_code: int, detail: str, *, field: str, value: str, bound: str) -> None:
        super().__init__(status_code, detail)
        self.problem_fields = {"field": field, "value": value, "bound": bound}


class Doorway:
    """Checks the Host header, bounds the body as it is read, and adds the security headers to every answer."""

    def __init__(self, app: ASGIApp, host_names: tuple[str, ...], max_body_bytes: int) -> None:
        self._app = app
        self._host_names = host_names
        self._max_body_bytes = max_body_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let a request in, or refuse it."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, _in_one_line(scope, send))
            return
        host = _host_name(Headers(scope=scope).get("host", ""))
        if "*" not in self._host_names and host not in self._host_names:
            await self._refuse_host(host, scope, receive, send)
        elif scope["type"] == "websocket":
            await self._app(scope, receive, send)
        else:
            await self._app(scope, _bounded(scope, receive, self._max_body_bytes), _with_headers(send, scope))

    async def _refuse_host(self, host: str, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a name that is not ours: a foreign page's name may have been pointed at this machine."""
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": "host"})
            return
        bound = f"one of {', '.join(self._host_names)}"
        error = RefusedError(421, "This name is not served here", field="Host", value=host[:80], bound=bound)
        await problem_response(problem_of(error))(scope, receive, _with_headers(send))


def _in_one_line(scope: Scope, send: Send) -> Send:
    """Let the log say why nothing was started, where that is known, instead of where in the program it was found."""

    async def send_in_one_line(message: Message) -> None:
        refusal = getattr(scope["app"].state, "start_refusal", None)
        if message["type"] == "lifespan.startup.failed" and refusal is not None:
            message = {**message, "message": f"nothing was started: {refusal}"}
        await send(message)

    return send_in_one_line


def _host_name(host: str) -> str:
    """Cut the port off; an IPv6 address keeps its brackets."""
    name, colon, port = host.rpartition(":")
    return name.lower() if colon and port.isdigit() else host.lower()


def _bounded(scope: Scope, receive: Receive, max_bytes: int) -> Receive:
    """Stop reading a body that is, or says it is, too large; nothing of a declared one is read."""
    declared = Headers(scope=scope).get("content-length", "0")
    seen_bytes = 0

    async def receive_bounded() -> Message:
        nonlocal seen_bytes
        if not declared.isdecimal() or int(declared[:20]) > max_bytes:
            raise _too_large(f"{declared[:20]} bytes", max_bytes)
        message = await receive()
        seen_bytes += len(message.get("body", b""))
        if seen_bytes > max_bytes:
            raise _too_large("more bytes than that", max_bytes)
        return message

    return receive_bounded


def _too_large(value: str, max_bytes: int) -> RefusedError:
    return RefusedError(413, "The body is too large", field="body", value=value, bound=f"at most {max_bytes} bytes")


def _with_headers(send: Send, scope: Scope | None = None) -> Send:
    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in SECURITY_HEADERS.items():
                headers[name] = value
            headers.setdefault("Cache-Control", "no-cache")
            for name, value in _deprecation(scope or {}).items():
                headers[name] = value
        await send(message)

    return send_with_headers


def _deprecation(scope: Mapping[str, Any]) -> dict[str, str]:
    """Return the headers of a call that should not be used any more."""
    said = DEPRECATED.get(scope.get(RULE, ("", "")))
    return {} if said is None else said.headers()
