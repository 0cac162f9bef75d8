"""Log-ins, people and keys as they go over HTTP; a secret stands in no answer but that of the call that made it."""

from typing import Annotated, Literal

from pydantic import AwareDatetime, Field, SecretStr, StringConstraints

from service.access.accounts.passwords import MAX_LENGTH, MIN_LENGTH
from service.access.accounts.records import MAX_LENGTH as LONGEST_NAME
from service.core.permissions import Permission, Role
from service.core.schemas.base import Answer, Name, Request

Password = Annotated[SecretStr, Field(min_length=1, max_length=MAX_LENGTH)]
NewPassword = Annotated[SecretStr, Field(min_length=MIN_LENGTH, max_length=MAX_LENGTH)]
Reason = Annotated[str, StringConstraints(min_length=8, max_length=500)]
LoginId = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]
KeyId = Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{12}$")]
PersonName = Annotated[str, StringConstraints(min_length=1, max_length=LONGEST_NAME)]
Roles = Annotated[list[Annotated[Role, Field(strict=False)]], Field(min_length=1, max_length=len(Role))]
Scopes = Annotated[list[Annotated[Permission, Field(strict=False)]], Field(min_length=1, max_length=len(Permission))]


class LoginRequest(Request):
    """A name and a password."""

    name: Annotated[str, StringConstraints(min_length=1, max_length=LONGEST_NAME)] = Field(examples=["A. Therapist"])
    password: Password
    reason: Reason | None = Field(
        default=None,
        description="Why the identity provider is gone round; asked of break-glass accounts",
    )


class PasswordRequest(Request):
    """The old password and the new."""

    old_password: Password
    new_password: NewPassword


class Me(Answer):
    """Who is logged in, and what they may do."""

    name: str
    kind: Literal["user", "key", "oidc", "machine"]
    roles: list[Role]
    permissions: list[Permission] = Field(description="What the roles unite; nothing but the password while it is due")
    must_change_password: bool
    is_break_glass: bool = Field(default=False, description="Logged in past the identity provider: to be shown")
    way: Literal["password", "oidc"] | None = None
    expires_at: AwareDatetime | None = Field(default=None, description="When the log-in ends, used or not")
    idle_minutes: float | None = Field(default=None, description="It ends sooner where nothing is asked for so long")


class LoginView(Answer):
    """A log-in that is open."""

    id: LoginId
    way: Literal["password", "oidc"]
    address: str
    created_at: AwareDatetime
    expires_at: AwareDatetime
    seen_at: AwareDatetime
    is_this: bool = Field(description="The one that asks")


class LoginList(Answer):
    """A person's log-ins, oldest first."""

    items: list[LoginView]


class UserRequest(Request):
    """A new person; the service makes the password and returns it once."""

    name: Name
    roles: Roles
    is_break_glass: bool = Field(default=False, description="May log in by password while the identity provider is on")


class UserChange(Request):
    """What is changed of a person; what is left out stays."""

    roles: Roles | None = None
    is_disabled: bool | None = Field(default=None, description="Ends every log-in; accounts are never deleted")
    is_break_glass: bool | None = None
    reset_password: bool = Field(default=False, description="Make a new one, to be changed at the next log-in")


class UserView(Answer):
    """A person."""

    name: str
    roles: list[Role]
    is_disabled: bool
    must_change_password: bool
    is_break_glass: bool
    issuer: str | None = Field(default=None, description="The identity provider that keeps this person")
    created_at: AwareDatetime
    last_login_at: AwareDatetime | None
    one_time_password: str | None = Field(default=None, description="Only where it was just made; shown never again")


class UserList(Answer):
    """Everybody, by name."""

    items: list[UserView]
    next_cursor: None = None


class KeyRequest(Request):
    """A new key for a machine."""

    name: Annotated[Name, StringConstraints(max_length=60)] = Field(examples=["planning"])
    scopes: Scopes = Field(
        description="Any permissions but gate.reference, gate.acknowledge, qa.run, users.manage and coach.manage"
    )
    expires_at: Annotated[AwareDatetime, Field(strict=False)] = Field(description="Bounded by the site's settings")


class KeyView(Answer):
    """A machine's key."""

    id: KeyId
    name: str
    scopes: list[Permission]
    created_by: str
    created_at: AwareDatetime
    expires_at: AwareDatetime
    revoked_at: AwareDatetime | None
    last_used_at: AwareDatetime | None


class MadeKeyView(KeyView):
    """A key that was just made."""

    secret: str = Field(description="Send it as `Authorization: Bearer ...`; shown never again")


class KeyList(Answer):
    """The keys, newest first."""

    items: list[KeyView]
    next_cursor: None = None
