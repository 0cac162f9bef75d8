"""The cookies of log-ins and of paired screens: HttpOnly, host-only, SameSite=Strict; over https ``__Host-``.

A room's name is a part of theirs: browsers do not part the cookies of two ports of one host.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from starlette.requests import cookie_parser
from starlette.responses import Response

PLAIN_NAME = "tidegate_login"
SCREEN_NAME = "tidegate_screen"
SECURE_PREFIX = "__Host-"


@dataclass(frozen=True, slots=True, kw_only=True)
class CookieScope:
    """Where the cookies of this service apply: https or http, and the room."""

    is_secure: bool
    room: str = ""

    def name(self, plain: str) -> str:
        """Return a cookie's name; with ``__Host-`` a browser accepts it only from this host over https."""
        named = f"{plain}_{self.room}" if self.room else plain
        return f"{SECURE_PREFIX}{named}" if self.is_secure else named


def cookie_name(scope: CookieScope) -> str:
    """Return the name of a log-in's cookie."""
    return scope.name(PLAIN_NAME)


def screen_cookie_name(scope: CookieScope) -> str:
    """Return the name of a paired screen's cookie."""
    return scope.name(SCREEN_NAME)


def set_login_cookie(response: Response, token: str, scope: CookieScope) -> None:
    """Set a session cookie with the token; it has no expiry of its own, the log-in's expiry is checked here."""
    response.set_cookie(cookie_name(scope), token, path="/", secure=scope.is_secure, httponly=True, samesite="strict")


def set_screen_cookie(response: Response, token: str, scope: CookieScope) -> None:
    """Set a session cookie with a paired screen's token."""
    response.set_cookie(
        screen_cookie_name(scope), token, path="/", secure=scope.is_secure, httponly=True, samesite="strict"
    )


def drop_login_cookie(response: Response, scope: CookieScope) -> None:
    """Delete the login cookie in the browser; does not end the log-in."""
    response.delete_cookie(cookie_name(scope), path="/", secure=scope.is_secure, httponly=True, samesite="strict")


def token_in(headers: Mapping[str, str], scope: CookieScope) -> str | None:
    """Return the token from the Cookie header, None if there is none."""
    return cookie_parser(headers.get("cookie", "")).get(cookie_name(scope))


def screen_token_in(headers: Mapping[str, str], scope: CookieScope) -> str | None:
    """Return a paired screen's token from the Cookie header, None if there is none."""
    return cookie_parser(headers.get("cookie", "")).get(screen_cookie_name(scope))
