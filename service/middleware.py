"""What every request passes: the host's name, a bound on the body, and headers that keep the page to itself."""

from collections.abc import Mapping
from typing import Any

import anyio
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.access.identity import RULE
from service.deprecation import DEPRECATED
from service.problems import problem_of, problem_response

MAX_BODY_S = 30.0
SECURITY_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'self'; object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Origin-Agent-Cluster": "?1",
    "Permissions-Policy": (
        "accelerometer=(), camera=(), display-capture=(), geolocation=(), gyroscope=(), magnetometer=(), "
        "microphone=(), midi=(), payment=(), serial=(), usb=()"
    ),
    "X-Permitted-Cross-Domain-Policies": "none",
}


class RefusedError(HTTPException):
    """A request refused at the door; carries field, value and bound for the problem."""

    def __init__(self, status_code: int, detail: str, *, field: str, value: str, bound: str) -> None:
        super().__init__(status_code, detail)
        self.problem_fields = {"field": field, "value": value, "bound": bound}


class Doorway:
    """Checks the Host header, bounds the body as it is read, and adds the security headers to every answer."""

    def __init__(
        self,
        app: ASGIApp,
        host_names: tuple[str, ...],
        max_body_bytes: int,
        max_body_s: float = MAX_BODY_S,
        larger_bodies: Mapping[tuple[str, str], int] | None = None,
    ) -> None:
        self._app = app
        self._host_names = host_names
        self._max_body_bytes = max_body_bytes
        self._max_body_s = max_body_s
        self._larger_bodies = larger_bodies or {}

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
            most = self._larger_bodies.get((scope["method"], scope["path"]), self._max_body_bytes)
            await self._app(
                scope,
                _in_time(_bounded(scope, receive, most), self._max_body_s),
                _with_headers(send, scope),
            )

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
        _refuse_packed(scope)
        if not declared.isdecimal() or int(declared[:20]) > max_bytes:
            raise _too_large(f"{declared[:20]} bytes", max_bytes)
        message = await receive()
        seen_bytes += len(message.get("body", b""))
        if seen_bytes > max_bytes:
            raise _too_large("more bytes than that", max_bytes)
        return message

    return receive_bounded


def _in_time(receive: Receive, max_s: float) -> Receive:
    """Wait for the whole body only for so long; whoever waits for the client to leave may do so for ever."""
    is_whole = False
    ends_s: float | None = None

    async def receive_in_time() -> Message:
        nonlocal is_whole, ends_s
        if is_whole:
            return await receive()
        ends_s = ends_s or anyio.current_time() + max_s
        with anyio.move_on_after(ends_s - anyio.current_time()):
            message = await receive()
            is_whole = not message.get("more_body", False)
            return message
        bound = f"complete within {max_s:g} s"
        raise RefusedError(408, "The body took too long", field="body", value="a part of it", bound=bound)

    return receive_in_time


def _refuse_packed(scope: Scope) -> None:
    """Refuse a body that is packed: what it unpacks to has no bound that is known beforehand."""
    encoding = Headers(scope=scope).get("content-encoding", "identity")
    if encoding.lower() not in {"identity", ""}:
        bound = "identity, or left out"
        raise RefusedError(
            415, "The body must not be packed", field="Content-Encoding", value=encoding[:80], bound=bound
        )


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
