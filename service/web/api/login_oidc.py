"""Routes for log-in at the hospital's identity provider: methods, redirect to the provider, return from it.

The temporary cookie is ``SameSite=Lax``: the return is a navigation from another site, for which browsers do not send a
strict cookie. The cookie alone grants nothing and expires with the pending log-in.

Schemas of the available log-in methods.
"""

from html import escape
from typing import Annotated, Literal, cast

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import Field

from service.access.login.cookies import CookieScope, set_login_cookie
from service.access.oidc.pending_logins import LIFE_S
from service.access.oidc.people import AuthorizationResponse
from service.access.oidc.refusals import OidcReason
from service.access.oidc.service import BUSY, DISABLED, NOT_OFFERED, STORAGE, UNAVAILABLE, OidcService, Refusal
from service.core.schemas.base import Answer
from service.web import dependencies

router = APIRouter(tags=["access"])
PLAIN_NAME = "tidegate_oidc"
Text = Annotated[str | None, Query(max_length=2_048)]
PAGE: dict[int | str, dict[str, object]] = {
    200: {"description": "Never", "content": {"text/html": {}}},
    303: {"description": "Redirect to the provider", "headers": {"Location": {"schema": {"type": "string"}}}},
    403: {"description": "A page with the reason of the refusal", "content": {"text/html": {}}},
    503: {"description": "A page with the reason why the provider is unavailable", "content": {"text/html": {}}},
}
SENTENCE = {
    OidcReason.NO_ROLE: "None of your groups has access to this system. Ask the administrator of the groups.",
    OidcReason.STATE: "This log-in expired, was used before, or was started in another browser. Start again.",
    OidcReason.PROVIDER_REFUSED: "The log-in there was refused.",
    OidcReason.UNKNOWN_KEY: "The provider has just changed its keys. Try again in half a minute.",
    NOT_OFFERED: "This system does not use the provider. Log in by password.",
    DISABLED: "Your account is disabled here. Ask the administrator of this system.",
    UNAVAILABLE: "The provider does not answer. A break-glass account can log in by password.",
    BUSY: "Too many log-ins at once, or too many failed log-ins from this address. Try again in a few minutes.",
    STORAGE: "The database of this system does not answer. Try again.",
}
OTHERWISE = "The provider's answer is not valid. If this happens again, inform the administrator of this system."
PASSING = frozenset({UNAVAILABLE, BUSY, STORAGE})


class OidcWay(Answer):
    """The hospital's identity provider."""

    label: str = Field(description="Label of the button")
    is_reachable: bool = Field(description="Whether the provider answered the last request; informative")


class LoginWays(Answer):
    """Log-in methods that the page offers."""

    password: bool
    local_accounts: Literal["all", "break-glass"] = Field(
        description="Accounts that may log in by password; a break-glass account must give a reason"
    )
    oidc: OidcWay | None


def oidc_desk(request: Request) -> OidcService:
    """Find the provider's desk on the application; made in the lifespan."""
    return cast("OidcService", request.app.state.oidc)


Oidc = Annotated[OidcService, Depends(oidc_desk)]


@router.get("/login/ways")
def list_login_ways(oidc: Oidc) -> LoginWays:
    """Return the available log-in methods; public, for the page before log-in."""
    way = OidcWay(label=oidc.settings.oidc_label, is_reachable=oidc.is_reachable) if oidc.has_people else None
    is_all = way is None or oidc.settings.oidc_local_accounts == "all"
    return LoginWays(password=True, local_accounts="all" if is_all else "break-glass", oidc=way)


@router.get("/login/oidc", status_code=303, response_class=HTMLResponse, responses=PAGE)
def begin_oidc_login(oidc: Oidc, desk: dependencies.Access, address: dependencies.Address) -> Response:
    """Redirect the browser to the provider."""
    departure = oidc.begin_login(address)
    if isinstance(departure, Refusal):
        return _refusal(departure, oidc, desk.cookies)
    answer = RedirectResponse(departure.url, status_code=303, headers={"Cache-Control": "no-store"})
    answer.set_cookie(
        desk.cookies.name(PLAIN_NAME),
        departure.browser_secret,
        max_age=int(LIFE_S),
        path="/",
        secure=desk.cookies.is_secure,
        httponly=True,
        samesite="lax",
    )
    return answer


@router.get("/login/oidc/return", status_code=303, response_class=HTMLResponse, responses=PAGE)
def finish_oidc_login(
    request: Request,
    oidc: Oidc,
    desk: dependencies.Access,
    address: dependencies.Address,
    state: Annotated[str, Query(max_length=200)] = "",
    code: Text = None,
    error: Text = None,
    iss: Text = None,
) -> Response:
    """Complete the log-in after the provider's redirect; the browser always continues to the page."""
    browser = request.cookies.get(desk.cookies.name(PLAIN_NAME))
    opened = oidc.finish_login(AuthorizationResponse(state=state, code=code, error=error, issuer=iss), browser, address)
    if isinstance(opened, Refusal):
        return _refusal(opened, oidc, desk.cookies)
    answer = RedirectResponse("/", status_code=303, headers={"Cache-Control": "no-store"})
    set_login_cookie(answer, opened.token, desk.cookies)
    _drop_cookie(answer, desk.cookies)
    return answer


def _refusal(refusal: Refusal, oidc: OidcService, scope: CookieScope) -> Response:
    """Return the page of a refusal; it contains only fixed texts, no input."""
    label = oidc.settings.oidc_label
    label = escape(label[:1].upper() + label[1:])
    sentence = escape(SENTENCE.get(refusal.reason, OTHERWISE))
    answer = HTMLResponse(
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Not logged in</title>'
        f'<meta name="viewport" content="width=device-width"><link rel="icon" href="/icon.svg">'
        f'<link rel="stylesheet" href="/css/refused.css">'
        f"<main><h1>Not logged in</h1><p>{label}: {sentence}</p>"
        f'<p><a href="/">Back to log-in</a></p><p class="code">{escape(refusal.reason)}</p></main></html>',
        status_code=503 if refusal.reason in PASSING else 403,
        headers={"Cache-Control": "no-store"},
    )
    _drop_cookie(answer, scope)
    return answer


def _drop_cookie(answer: Response, scope: CookieScope) -> None:
    answer.delete_cookie(scope.name(PLAIN_NAME), path="/", secure=scope.is_secure, httponly=True, samesite="lax")
