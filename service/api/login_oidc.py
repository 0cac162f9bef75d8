"""Log in at the hospital's provider: which ways there are, out to the provider, back from it.

The cookie that is kept meanwhile is ``SameSite=Lax``: the way back is a link that another site's page follows, with
which no browser sends a strict one. It opens nothing by itself, and lasts as long as the way may take.
"""

from html import escape
from typing import Annotated, cast

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, Response

from service import deps
from service.access.cookies import set_login_cookie
from service.access.oidc_attempts import LIFE_S
from service.access.oidc_desk import BUSY, DISABLED, NOT_OFFERED, STORAGE, UNAVAILABLE, OidcDesk, Refusal
from service.access.oidc_errors import OidcReason
from service.access.oidc_people import Returned
from service.api import problems
from service.oidc_schemas import LoginWays, OidcWay

router = APIRouter(tags=["access"])
PLAIN_NAME = "tidegate_oidc"
Text = Annotated[str | None, Query(max_length=2_048)]
PAGE: dict[int | str, dict[str, object]] = {
    200: {"description": "Never", "content": {"text/html": {}}},
    303: {"description": "Go there", "headers": {"Location": {"schema": {"type": "string"}}}},
    403: {"description": "A page that says why nobody is let in", "content": {"text/html": {}}},
    503: {"description": "A page that says that it cannot be asked now", "content": {"text/html": {}}},
}
SENTENCE = {
    OidcReason.NO_ROLE: "It knows you, but none of your groups may use this system. Ask whoever keeps the groups.",
    OidcReason.STATE: "This log-in took too long, was used before, or was begun in another browser. Begin again.",
    OidcReason.PROVIDER_REFUSED: "It did not let you in there.",
    OidcReason.UNKNOWN_KEY: "It has just changed its keys. Try again in half a minute.",
    NOT_OFFERED: "Nobody logs in that way here; a password is what counts.",
    DISABLED: "Your account is disabled here. Ask whoever administers this system.",
    UNAVAILABLE: "It does not answer. A break-glass account can log in by password.",
    BUSY: "Too many people log in at once, or too many log-ins have failed from here. Try again in some minutes.",
    STORAGE: "The database here does not answer, so nobody can be let in. Try again.",
}
OTHERWISE = "What it told of you cannot be trusted. If that happens again, tell whoever administers this system."
PASSING = frozenset({UNAVAILABLE, BUSY, STORAGE})


def oidc_desk(request: Request) -> OidcDesk:
    """Find the provider's desk on the application; made in the lifespan."""
    return cast("OidcDesk", request.app.state.oidc)


Oidc = Annotated[OidcDesk, Depends(oidc_desk)]


@router.get("/login/ways")
def list_login_ways(oidc: Oidc) -> LoginWays:
    """Tell by which ways one may log in; for the page, before anybody has."""
    way = OidcWay(label=oidc.settings.oidc_label, is_reachable=oidc.is_reachable) if oidc.has_people else None
    is_all = way is None or oidc.settings.oidc_local_accounts == "all"
    return LoginWays(password=True, local_accounts="all" if is_all else "break-glass", oidc=way)


@router.get("/login/oidc", status_code=303, response_class=HTMLResponse, responses=PAGE)
def begin_oidc_login(oidc: Oidc, desk: deps.Access, address: deps.Address) -> Response:
    """Send the browser to the provider."""
    departure = oidc.set_out(address)
    if isinstance(departure, Refusal):
        return _refusal(departure, oidc, is_secure=desk.is_secure)
    answer = RedirectResponse(departure.url, status_code=303, headers={"Cache-Control": "no-store"})
    answer.set_cookie(
        cookie_name(is_secure=desk.is_secure),
        departure.browser_secret,
        max_age=int(LIFE_S),
        path="/",
        secure=desk.is_secure,
        httponly=True,
        samesite="lax",
    )
    return answer


@router.get("/login/oidc/return", status_code=303, response_class=HTMLResponse, responses=PAGE | problems(422))
def finish_oidc_login(
    request: Request,
    oidc: Oidc,
    desk: deps.Access,
    address: deps.Address,
    state: Annotated[str, Query(max_length=200)] = "",
    code: Text = None,
    error: Text = None,
    iss: Text = None,
) -> Response:
    """Let somebody in whom the provider sends back; always to the page, wherever else a link may want to lead."""
    browser = request.cookies.get(cookie_name(is_secure=desk.is_secure))
    opened = oidc.come_back(Returned(state=state, code=code, error=error, issuer=iss), browser, address)
    if isinstance(opened, Refusal):
        return _refusal(opened, oidc, is_secure=desk.is_secure)
    answer = RedirectResponse("/", status_code=303, headers={"Cache-Control": "no-store"})
    set_login_cookie(answer, opened.token, is_secure=desk.is_secure)
    _drop_cookie(answer, is_secure=desk.is_secure)
    return answer


def cookie_name(*, is_secure: bool) -> str:
    """Return the cookie's name; no neighbouring host can set one with the prefix."""
    return f"__Host-{PLAIN_NAME}" if is_secure else PLAIN_NAME


def _refusal(refusal: Refusal, oidc: OidcDesk, *, is_secure: bool) -> Response:
    """Answer with a page of fixed words: nothing that came from outside stands in it."""
    label = oidc.settings.oidc_label
    label = escape(label[:1].upper() + label[1:])
    sentence = escape(SENTENCE.get(refusal.reason, OTHERWISE))
    answer = HTMLResponse(
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>Not logged in</title>'
        f'<meta name="viewport" content="width=device-width"><link rel="icon" href="/icon.svg">'
        f'<link rel="stylesheet" href="/css/refused.css">'
        f"<main><h1>Not logged in</h1><p>{label}: {sentence}</p>"
        f'<p><a href="/">Back to the log-in</a></p><p class="code">{escape(refusal.reason)}</p></main></html>',
        status_code=503 if refusal.reason in PASSING else 403,
        headers={"Cache-Control": "no-store"},
    )
    _drop_cookie(answer, is_secure=is_secure)
    return answer


def _drop_cookie(answer: Response, *, is_secure: bool) -> None:
    answer.delete_cookie(cookie_name(is_secure=is_secure), path="/", secure=is_secure, httponly=True, samesite="lax")
