"""The cookies of log-ins and of paired screens: HttpOnly, host-only, SameSite=Strict; over https ``__Host-``."""

from collections.abc import Mapping

from starlette.requests import cookie_parser
from starlette.responses import Response

PLAIN_NAME = "tidegate_login"
SCREEN_NAME = "tidegate_screen"
SECURE_PREFIX = "__Host-"


def cookie_name(*, is_secure: bool) -> str:
    """Return the cookie's name; with ``__Host-`` a browser accepts it only from this host over https."""
    return _named(PLAIN_NAME, is_secure=is_secure)


def screen_cookie_name(*, is_secure: bool) -> str:
    """Return the name of a paired screen's cookie."""
    return _named(SCREEN_NAME, is_secure=is_secure)


def _named(name: str, *, is_secure: bool) -> str:
    return f"{SECURE_PREFIX}{name}" if is_secure else name


def set_login_cookie(response: Response, token: str, *, is_secure: bool) -> None:
    """Set a session cookie with the token; it has no expiry of its own, the log-in's expiry is checked here."""
    response.set_cookie(
        cookie_name(is_secure=is_secure), token, path="/", secure=is_secure, httponly=True, samesite="strict"
    )


def set_screen_cookie(response: Response, token: str, *, is_secure: bool) -> None:
    """Set a session cookie with a paired screen's token."""
    response.set_cookie(
        screen_cookie_name(is_secure=is_secure), token, path="/", secure=is_secure, httponly=True, samesite="strict"
    )


def drop_login_cookie(response: Response, *, is_secure: bool) -> None:
    """Delete the login cookie in the browser; does not end the log-in."""
    response.delete_cookie(
        cookie_name(is_secure=is_secure), path="/", secure=is_secure, httponly=True, samesite="strict"
    )


def token_in(headers: Mapping[str, str], *, is_secure: bool) -> str | None:
    """Return the token from the Cookie header, None if there is none."""
    return cookie_parser(headers.get("cookie", "")).get(cookie_name(is_secure=is_secure))


def screen_token_in(headers: Mapping[str, str], *, is_secure: bool) -> str | None:
    """Return a paired screen's token from the Cookie header, None if there is none."""
    return cookie_parser(headers.get("cookie", "")).get(screen_cookie_name(is_secure=is_secure))
