"""People, log-ins, keys and failed attempts, as they are kept: values; a change is a new one."""

from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from service.access.names import name_key
from service.access.permissions import Permission, Role

Way = Literal["password", "oidc"]


@dataclass(frozen=True, slots=True, kw_only=True)
class User:
    """A person; never deleted, for the audit names them. ``password_hash`` is None for those of an OIDC provider."""

    name: str
    password_hash: str | None
    roles: frozenset[Role]
    is_disabled: bool = False
    must_change_password: bool = False
    is_break_glass: bool = False
    issuer: str | None = None
    subject: str | None = None
    created_at: datetime
    last_login_at: datetime | None = None

    @property
    def key(self) -> str:
        """What it is found by."""
        return name_key(self.name)


@dataclass(frozen=True, slots=True, kw_only=True)
class Login:
    """A person at one browser; the token itself is only there."""

    id: str
    token_sha256: str
    user_key: str
    way: Way
    address: str
    is_break_glass: bool = False
    created_at: datetime
    expires_at: datetime
    seen_at: datetime

    @property
    def key(self) -> str:
        """What it is found by."""
        return self.token_sha256


@dataclass(frozen=True, slots=True, kw_only=True)
class ApiKey:
    """A machine's key; the secret itself was shown once."""

    id: str
    name: str
    secret_sha256: str
    scopes: frozenset[Permission]
    created_by: str
    created_at: datetime
    expires_at: datetime
    revoked_at: datetime | None = None
    last_used_at: datetime | None = None

    @property
    def key(self) -> str:
        """What it is found by."""
        return self.id


@dataclass(frozen=True, slots=True, kw_only=True)
class Attempts:
    """How often log-ins have failed for a name or from an address, since the last that did not."""

    subject: str
    failures: int
    last_at: datetime
    locked_until: datetime | None = None

    @property
    def key(self) -> str:
        """What it is found by."""
        return self.subject


Record = User | Login | ApiKey | Attempts
