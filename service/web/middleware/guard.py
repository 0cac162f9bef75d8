"""The guard: checks every request against the access rules before its body is read; without a rule it is refused.

Origin check against cross-site requests: browsers set the Origin header, and a page cannot forge it.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import cast
from urllib.parse import urlsplit

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.responses import FileResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from service.access.request.addresses import ClientAddresses
from service.access.request.identity import RULE, STATE, Identity
from service.access.request.rules import BEFORE_THE_PASSWORD_IS_CHANGED, PEOPLE_ONLY, SOCKET, Open, Rule, RuleTable
from service.access.service import AccessService
from service.core.errors import (
    NotLoggedInError,
    OriginRefusedError,
    PasswordChangeDueError,
    PermissionMissingError,
    PersonRequiredError,
    ServiceError,
)
from service.core.permissions import Permission
from service.storage.audit import Event
from service.web.problems.table import problem_of, problem_response

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
POLICY_VIOLATION = 1008
REFUSED = "access.refused"
ADDRESS = "tidegate.address"
"""Key of the sender's address in the ASGI scope."""


def is_ours(origin: str, host: str, allowed: Sequence[str], *, is_secure: bool) -> bool:
    """Whether an Origin is this host's own page, or one that the site's settings allow."""
    if origin in allowed:
        return True
    try:
        parts = urlsplit(origin)
    except ValueError:
        return False
    schemes = ("https",) if is_secure else ("http", "https")
    return bool(host) and parts.scheme in schemes and parts.netloc.lower() == host.lower()


class Guard:
    """Admits a request by the table of rules, or answers with a problem that names what is missing."""

    def __init__(
        self,
        app: ASGIApp,
        *,
        callers: ClientAddresses,
        allowed_origins: Sequence[str],
        is_secure: bool,
        page_files: frozenset[str],
        nothing: Path | None = None,
        table: RuleTable | None = None,
    ) -> None:
        self._app = app
        self._callers = callers
        self._allowed_origins = allowed_origins
        self._is_secure = is_secure
        self._page_files = page_files
        self._nothing = nothing
        self._table = table or RuleTable()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Admit or refuse a request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        method = SOCKET if scope["type"] == "websocket" else scope["method"]
        scope[ADDRESS] = self._callers.address(scope)
        if method in {"GET", "HEAD"} and scope["path"] in self._page_files:
            await self._app(scope, receive, send)
            return
        lost = self._lost_page(scope, method)
        if lost is not None:
            await FileResponse(lost, 404, {"Cache-Control": "no-store"})(scope, receive, send)
            return
        try:
            self._check(scope, method)
        except (ServiceError, HTTPException) as error:
            if isinstance(error, OriginRefusedError):
                cast("AccessService", scope["app"].state.access).refused_logins.count("foreign pages", scope[ADDRESS])
            await _refuse(error, scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _lost_page(self, scope: Scope, method: str) -> Path | None:
        """Return the page for a browser that asks for one that there is not; the API answers with problems."""
        path = scope["path"]
        if method not in {"GET", "HEAD"} or path.startswith("/api/") or self._table.methods(path):
            return None
        return self._nothing if "text/html" in Headers(scope=scope).get("accept", "") else None

    def _check(self, scope: Scope, method: str) -> None:
        """Raise the error that refuses this request; else store identity and rule in the scope."""
        desk = cast("AccessService", scope["app"].state.access)
        headers = Headers(scope=scope)
        rule = self._table.find(method, scope["path"])
        self._check_origin(headers, method)
        if rule is not None and rule.needs is Open.PUBLIC:
            scope[RULE] = (rule.method, rule.template)
            return
        identity = _identify(desk, headers, rule)
        if identity is None:
            desk.refused_logins.count("not logged in", scope[ADDRESS])
            raise NotLoggedInError
        scope[STATE] = identity
        if rule is None:
            raise self._nothing_there(scope["path"])
        self._check_permission(desk, scope, identity, rule)
        scope[RULE] = (rule.method, rule.template)

    def _check_origin(self, headers: Headers, method: str) -> None:
        """Refuse calls with a cookie from another origin (CSRF), and all WebSockets from other origins."""
        origins = headers.getlist("origin")
        if len(origins) > 1:
            raise _foreign("more than one")
        origin = next(iter(origins), None)
        if origin is not None and (method == SOCKET or method not in SAFE_METHODS):
            if not is_ours(origin, headers.get("host", ""), self._allowed_origins, is_secure=self._is_secure):
                raise _foreign(origin)
        elif method not in SAFE_METHODS and method != SOCKET and comes_by_cookie(headers):
            raise _foreign("missing")

    @staticmethod
    def _check_permission(desk: AccessService, scope: Scope, identity: Identity, rule: Rule) -> None:
        call = (rule.method, rule.template)
        error: ServiceError | None = None
        if identity.must_change_password and call not in BEFORE_THE_PASSWORD_IS_CHANGED:
            error = PasswordChangeDueError("The password was set by an administrator. Change it first.")
        elif not isinstance(rule.needs, Open) and rule.needs not in identity.permissions:
            msg = f"{identity.name} does not have the permission {rule.needs}."
            error = PermissionMissingError(msg, field="permission", value="missing", bound=str(rule.needs))
        elif call in PEOPLE_ONLY and not identity.is_person:
            msg = f"{identity.name} is a program: only a person who has logged in may do this."
            error = PersonRequiredError(msg, field="caller", value=identity.kind, bound="a person's log-in")
        if error is None:
            return
        detail = {"method": rule.method, "path": rule.template, "code": error.code, "needs": error.bound}
        desk.refused_logins.record(
            Event(
                actor=identity.name,
                action=REFUSED,
                outcome="refused",
                detail=detail | {"address": scope[ADDRESS]},
            )
        )
        raise error

    def _nothing_there(self, path: str) -> HTTPException:
        methods = self._table.methods(path)
        if methods:
            return HTTPException(405, headers={"Allow": ", ".join(methods)})
        return HTTPException(404)


def _identify(desk: AccessService, headers: Headers, rule: Rule | None) -> Identity | None:
    """Authenticate the sender; only a rule of the coaching stream accepts the credential of a paired screen."""
    if rule is not None and rule.needs is Permission.COACH_WATCH:
        return desk.authenticator.identify_watcher(headers)
    return desk.authenticator.identify(headers)


def comes_by_cookie(headers: Headers) -> bool:
    """Whether the request is authenticated by cookie, which pages of other origins can send too."""
    return "authorization" not in headers and "cookie" in headers


def _foreign(origin: str) -> OriginRefusedError:
    bound = "the origin of this service's page"
    return OriginRefusedError(f"Origin must be {bound}", field="Origin", value=origin[:80], bound=bound)


async def _refuse(error: ServiceError | HTTPException, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        code = error.code if isinstance(error, ServiceError) else "not_found"
        await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": code})
        return
    await problem_response(problem_of(error), error.headers)(scope, receive, send)
