"""Checks of every request: Host header and size of the body; adds the security headers.

Checks before the route: all query parameters are known, and the answer's media type is acceptable.

Unknown parameters are refused: a misspelt one that is ignored would be an export without its limit.
"""

import re
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import anyio
from fastapi import Request
from fastapi.dependencies.models import Dependant
from fastapi.routing import APIRoute
from pydantic import BaseModel
from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.access.request.identity import RULE
from service.access.request.rules import TAKES_PERMISSION_AWAY
from service.core.errors import BoundError, NotAcceptableError
from service.web.problems.table import problem_of, problem_response

MAX_BODY_S = 30.0
MAX_BODY_BYTES = 65_536
MAX_PLAN_BYTES = 8_388_608
"""Largest RT Plan, the largest body of any call; every other one is bounded by `MAX_BODY_BYTES`."""
SESSION_PATH = re.compile(r"(?<=/sessions/)[^/]+")
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
DOCS = "/docs"
"""Address of the documentation: files of the image, where they were built into it."""
DOCS_POLICY = f"{SECURITY_HEADERS['Content-Security-Policy']}; style-src 'self' 'unsafe-inline'; img-src 'self' data:"
"""The site's theme has styles and icons within its pages; scripts within a page stay forbidden there too."""
MAY_HAVE_MORE = frozenset({"/login/oidc", "/login/oidc/return"})
"""Route of the identity provider's redirect, which may have any parameters."""
PROBLEM = "application/problem+json"


class RefusedError(HTTPException):
    """A request refused by this middleware, with field, value and bound for the problem."""

    def __init__(self, status_code: int, detail: str, *, field: str, value: str, bound: str) -> None:
        super().__init__(status_code, detail)
        self.problem_fields = {"field": field, "value": value, "bound": bound}


class RequestMiddleware:
    """Checks the Host header, limits the body while it is read, and adds the security headers to every answer."""

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
        """Process or refuse a request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, _in_one_line(scope, send))
            return
        host = _host_name(Headers(scope=scope).get("host", ""))
        if "*" not in self._host_names and host not in self._host_names:
            await self._refuse_host(host, scope, receive, send)
        elif scope["type"] == "websocket":
            await self._app(scope, receive, send)
        else:
            call = (scope["method"], SESSION_PATH.sub("{session_id}", scope["path"]))
            most = self._larger_bodies.get(call, self._max_body_bytes)
            await self._app(
                scope,
                _in_time(_bounded(scope, receive, most), self._max_body_s),
                _with_headers(send, scope),
            )

    async def _refuse_host(self, host: str, scope: Scope, receive: Receive, send: Send) -> None:
        """Refuse a foreign host name: it may be an attack by DNS rebinding."""
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008, "reason": "host"})
            return
        bound = f"one of {', '.join(self._host_names)}"
        error = RefusedError(421, "This host name is not served", field="Host", value=host[:80], bound=bound)
        await problem_response(problem_of(error))(scope, receive, _with_headers(send, scope))


def _in_one_line(scope: Scope, send: Send) -> Send:
    """Replace the trace of a refused start by its reason, if that is known."""

    async def send_in_one_line(message: Message) -> None:
        refusal = getattr(scope["app"].state, "start_refusal", None)
        if message["type"] == "lifespan.startup.failed" and refusal is not None:
            message = {**message, "message": f"the service did not start: {refusal}"}
        await send(message)

    return send_in_one_line


def _host_name(host: str) -> str:
    """Return the host without the port; an IPv6 address keeps its brackets."""
    name, colon, port = host.rpartition(":")
    return name.lower() if colon and port.isdigit() else host.lower()


def _bounded(scope: Scope, receive: Receive, max_bytes: int) -> Receive:
    """Refuse a body that is too large, unread if its Content-Length is."""
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
            raise _too_large("more than that", max_bytes)
        return message

    return receive_bounded


def _in_time(receive: Receive, max_s: float) -> Receive:
    """Limit the time for the whole body; waiting for a disconnect afterwards is not limited."""
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
    """Refuse a compressed body: its uncompressed size is not known beforehand."""
    encoding = Headers(scope=scope).get("content-encoding", "identity")
    if encoding.lower() not in {"identity", ""}:
        bound = "identity, or left out"
        raise RefusedError(
            415, "The body must not be compressed", field="Content-Encoding", value=encoding[:80], bound=bound
        )


def _too_large(value: str, max_bytes: int) -> RefusedError:
    return RefusedError(413, "The body is too large", field="body", value=value, bound=f"at most {max_bytes} bytes")


def _with_headers(send: Send, scope: Scope) -> Send:
    async def send_with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            headers = MutableHeaders(scope=message)
            for name, value in SECURITY_HEADERS.items():
                headers[name] = value
            if scope["path"].startswith(f"{DOCS}/"):
                headers["Content-Security-Policy"] = DOCS_POLICY
            headers.setdefault("Cache-Control", "no-cache")
        await send(message)

    return send_with_headers


async def require_known_query(request: Request) -> None:
    """Refuse unknown and repeated parameters, except for hold, disarm and stop."""
    route = request.scope.get("route")
    if not isinstance(route, APIRoute) or route.path_format in MAY_HAVE_MORE or takes_beam_away(request):
        return
    known = _query_names(route)
    given = [name for name, _ in request.query_params.multi_items()]
    for name in given:
        if name not in known:
            bound = f"one of {', '.join(sorted(known))}" if known else "left out: this call has no query parameters"
            msg = "unknown parameter"
            raise BoundError(msg, field=name[:80], value="given", bound=bound)
        if given.count(name) > 1:
            msg = f"{name} is given more than once"
            raise BoundError(msg, field=name, value=f"{given.count(name)} times", bound="given once")


async def require_acceptable(request: Request) -> None:
    """Refuse a call whose media types the client does not accept, except for hold, disarm and stop."""
    accept = request.headers.get("accept")
    if accept is None or takes_beam_away(request):
        return
    offered = _offered(request.scope.get("route"))
    if offered and not any(_matches(wanted, offered) for wanted in accept.split(",")):
        bound = " or ".join(offered)
        msg = f"Accept must include {bound}"
        raise NotAcceptableError(msg, field="Accept", value=accept, bound=bound)


def _query_names(route: APIRoute) -> frozenset[str]:
    return frozenset(_walk(route.dependant))


def _walk(dependant: Dependant) -> Iterator[str]:
    """Yield the names of a call's parameters, including those of its dependencies."""
    for field in dependant.query_params:
        model = field.field_info.annotation
        if isinstance(model, type) and issubclass(model, BaseModel):  # each of its fields is a parameter
            yield from (parameter.alias or name for name, parameter in model.model_fields.items())
        else:
            yield field.alias
    for further in dependant.dependencies:
        yield from _walk(further)


def _offered(route: Any) -> tuple[str, ...]:  # noqa: ANN401 - whatever the router found
    """Return the media types of a call's answer: documented ones, or JSON for a model; empty if unknown."""
    if not isinstance(route, APIRoute):
        return ()
    content = [
        media
        for status, response in route.responses.items()
        if _is_good(status)
        for media in response.get("content", ())
    ]
    if content:
        return tuple(dict.fromkeys(content))
    return ("application/json",) if route.response_field is not None else ()


def _is_good(status: int | str) -> bool:
    return str(status).startswith("2")


def takes_beam_away(request: Request) -> bool:
    """Whether the call is hold, disarm or stop, by its access rule."""
    return request.scope.get(RULE) in TAKES_PERMISSION_AWAY


def _matches(wanted: str, offered: Iterable[str]) -> bool:
    """Whether one part of an Accept header matches an offered type; q=0 does not."""
    media, *parameters = (part.strip().lower() for part in wanted.split(";"))
    if any(parameter.replace(" ", "") in {"q=0", "q=0.0", "q=0.00", "q=0.000"} for parameter in parameters):
        return False
    kinds = {one.partition("/")[0] for one in offered}
    return media in {"*/*", "*", PROBLEM, *offered} or any(media == f"{kind}/*" for kind in kinds)
