"""The guard: every request passes it before anything of its body is read, and without a rule nobody passes."""

from collections.abc import Sequence
from typing import cast

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Receive, Scope, Send

from service.access.addresses import Callers
from service.access.desk import AccessDesk
from service.access.identity import RULE, STATE, Identity
from service.access.origins import SAFE_METHODS, is_ours
from service.access.rules import BEFORE_THE_PASSWORD_IS_CHANGED, SOCKET, Open, Rule, RuleTable
from service.audit import Event
from service.errors import (
    NotLoggedInError,
    OriginRefusedError,
    PasswordChangeDueError,
    PermissionMissingError,
    ServiceError,
)
from service.problems import problem_of, problem_response

POLICY_VIOLATION = 1008
REFUSED = "access.refused"
ADDRESS = "tidegate.address"
"""Where the guard leaves the sender's address in the ASGI scope."""


class Guard:
    """Lets a request in by the table of rules, or answers it with a problem that says what is missing."""

    def __init__(
        self,
        app: ASGIApp,
        *,
        callers: Callers,
        allowed_origins: Sequence[str],
        is_secure: bool,
        page_files: frozenset[str],
        table: RuleTable | None = None,
    ) -> None:
        self._app = app
        self._callers = callers
        self._allowed_origins = allowed_origins
        self._is_secure = is_secure
        self._page_files = page_files
        self._table = table or RuleTable()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Let in or refuse."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        method = SOCKET if scope["type"] == "websocket" else scope["method"]
        scope[ADDRESS] = self._callers.address(scope)
        if method in {"GET", "HEAD"} and scope["path"] in self._page_files:
            await self._app(scope, receive, send)
            return
        try:
            self._check(scope, method)
        except (ServiceError, HTTPException) as error:
            if isinstance(error, OriginRefusedError):
                cast("AccessDesk", scope["app"].state.access).ledger.count("foreign pages", scope[ADDRESS])
            await _refuse(error, scope, receive, send)
            return
        await self._app(scope, receive, send)

    def _check(self, scope: Scope, method: str) -> None:
        """Raise why this request may not come in; leave who it is and by which rule where the application finds it."""
        desk = cast("AccessDesk", scope["app"].state.access)
        headers = Headers(scope=scope)
        rule = self._table.find(method, scope["path"])
        self._check_origin(headers, method)
        if rule is not None and rule.needs is Open.PUBLIC:
            scope[RULE] = (rule.method, rule.template)
            return
        identity = desk.doorkeeper.identify(headers)
        if identity is None:
            desk.ledger.count("not logged in", scope[ADDRESS])
            raise NotLoggedInError
        scope[STATE] = identity
        if rule is None:
            raise self._nothing_there(scope["path"])
        self._check_permission(desk, scope, identity, rule)
        scope[RULE] = (rule.method, rule.template)

    def _check_origin(self, headers: Headers, method: str) -> None:
        """Refuse a call that a foreign page may have sent with the browser's cookie, and any foreign page's socket."""
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
    def _check_permission(desk: AccessDesk, scope: Scope, identity: Identity, rule: Rule) -> None:
        call = (rule.method, rule.template)
        error: ServiceError | None = None
        if identity.must_change_password and call not in BEFORE_THE_PASSWORD_IS_CHANGED:
            error = PasswordChangeDueError("the password was made by somebody else: change it first")
        elif not isinstance(rule.needs, Open) and rule.needs not in identity.permissions:
            msg = f"{identity.name} lacks the permission {rule.needs}"
            error = PermissionMissingError(msg, field="permission", value="missing", bound=str(rule.needs))
        if error is None:
            return
        detail = {"method": rule.method, "path": rule.template, "code": error.code, "needs": error.bound}
        desk.ledger.note(
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


def comes_by_cookie(headers: Headers) -> bool:
    """Whether a browser's cookie is what would let this in: then a foreign page may have sent it."""
    return "authorization" not in headers and "cookie" in headers


def _foreign(origin: str) -> OriginRefusedError:
    bound = "the page that is served here"
    return OriginRefusedError(f"Origin must be {bound}", field="Origin", value=origin[:80], bound=bound)


async def _refuse(error: ServiceError | HTTPException, scope: Scope, receive: Receive, send: Send) -> None:
    if scope["type"] == "websocket":
        code = error.code if isinstance(error, ServiceError) else "not_found"
        await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": code})
        return
    await problem_response(problem_of(error), error.headers)(scope, receive, send)
