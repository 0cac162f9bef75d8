"""By which ways one may log in, as it goes over HTTP."""

from typing import Literal

from pydantic import Field

from service.schema_base import Answer


class OidcWay(Answer):
    """The hospital's provider."""

    label: str = Field(description="What the button calls it")
    is_reachable: bool = Field(description="Whether it answered when last asked; decides nothing")


class LoginWays(Answer):
    """What the page offers to somebody who has not logged in."""

    password: bool
    local_accounts: Literal["all", "break-glass"] = Field(
        description="Whose passwords are taken; a break-glass account is asked for a reason"
    )
    oidc: OidcWay | None
