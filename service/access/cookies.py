"""The cookie of a log-in: out of reach of scripts, sent to nobody else, and not with a foreign page's requests."""

from collections.abc import Mapping

from starlette.requests import cookie_parser
from starlette.responses import Response

PLAIN_NAME = "tidegate_login"
SECURE_NAME = f"__Host-{PLAIN_NAME}"


def cookie_name(*, is_secure: bool) -> str:
    """Return the cookie's name; the prefix lets a browser take it from this very host over https alone."""
    return SECURE_NAME if is_secure else PLAIN_NAME


def set_login_cookie(response: Response, token: str, *, is_secure: bool) -> None:
    """Give the browser its token; until the browser closes, or the log-in ends here."""
    response.set_cookie(
        cookie_name(is_secure=is_secure), token, path="/", secure=is_secure, httponly=True, samesite="strict"
    )


def drop_login_cookie(response: Response, *, is_secure: bool) -> None:
    """Take the browser's token away."""
    response.delete_cookie(
        cookie_name(is_secure=is_secure), path="/", secure=is_secure, httponly=True, samesite="strict"
    )


def token_in(headers: Mapping[str, str], *, is_secure: bool) -> str | None:
    """Return the token a browser sent."""
    return cookie_parser(headers.get("cookie", "")).get(cookie_name(is_secure=is_secure))
