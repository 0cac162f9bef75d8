"""The login cookie: HttpOnly, host-only, SameSite=Strict, and Secure with a ``__Host-`` prefix over https."""

from collections.abc import Mapping

from starlette.requests import cookie_parser
from starlette.responses import Response

PLAIN_NAME = "tidegate_login"
SECURE_NAME = f"__Host-{PLAIN_NAME}"


def cookie_name(*, is_secure: bool) -> str:
    """Return the cookie's name; with ``__Host-`` a browser accepts it only from this host over https."""
    return SECURE_NAME if is_secure else PLAIN_NAME


def set_login_cookie(response: Response, token: str, *, is_secure: bool) -> None:
    """Set a session cookie with the token; it has no expiry of its own, the log-in's expiry is checked here."""
    response.set_cookie(
        cookie_name(is_secure=is_secure), token, path="/", secure=is_secure, httponly=True, samesite="strict"
    )


def drop_login_cookie(response: Response, *, is_secure: bool) -> None:
    """Delete the login cookie in the browser; does not end the log-in."""
    response.delete_cookie(
        cookie_name(is_secure=is_secure), path="/", secure=is_secure, httponly=True, samesite="strict"
    )


def token_in(headers: Mapping[str, str], *, is_secure: bool) -> str | None:
    """Return the token from the Cookie header, None if there is none."""
    return cookie_parser(headers.get("cookie", "")).get(cookie_name(is_secure=is_secure))
