"""Schemas of the available log-in methods."""

from typing import Literal

from pydantic import Field

from service.core.schemas.base import Answer


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
