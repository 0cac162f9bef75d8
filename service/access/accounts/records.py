"""Access records as frozen values: users, log-ins, API keys and counts of failed attempts.

Names of users and keys: which are allowed, and when two count as the same.
"""

import unicodedata
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from service.core.errors import BoundError
from service.core.identity import INVISIBLE, identity_key, identity_text, is_of_one_script
from service.core.permissions import Permission, Role

RESERVED = frozenset({"tidegate", "system", "unknown", "nobody", "anonymous"})
MAX_LENGTH = 80
KEY_PREFIX = "key:"
MACHINE_PREFIX = "machine:"
NOT_IN_NAMES = "/:"
Way = Literal["password", "oidc"]


def name_key(name: str) -> str:
    """Return the key by which names are compared: NFKC, case folded, without surrounding spaces."""
    return unicodedata.normalize("NFKC", name).casefold().strip()


def is_like(name: str, other: str) -> bool:
    """Whether two names look the same, so that a person could pass for another."""
    return identity_key(name) == identity_key(other)


def check_name(name: str) -> str:
    """Return the name as it is stored, in NFC, if it is allowed; raise BoundError otherwise."""
    name = unicodedata.normalize("NFC", name)
    bound = (
        f"1 to {MAX_LENGTH} printable characters of one script, without / and :, surrounding and double spaces, "
        f"and not {', '.join(sorted(RESERVED))}"
    )
    is_plain = bool(name.strip()) and name.isprintable() and not set(name) & {*NOT_IN_NAMES, *INVISIBLE}
    is_plain = is_plain and identity_text(name) == name and is_of_one_script(name)
    if not 1 <= len(name) <= MAX_LENGTH or not is_plain or name_key(name) in RESERVED:
        msg = f"name must be {bound}"
        raise BoundError(msg, field="name", value=name[:MAX_LENGTH], bound=bound)
    return name


@dataclass(frozen=True, slots=True, kw_only=True)
class User:
    """A user account. ``password_hash`` is None, and issuer and subject are set, for users of an OIDC provider."""

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
        """Key in `AccessStore.users`: the normalised name."""
        return name_key(self.name)


@dataclass(frozen=True, slots=True, kw_only=True)
class Login:
    """A user's log-in at one browser, which alone has the token. ``seen_at`` is saved once a minute."""

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
        """Key in `AccessStore.logins`: the SHA-256 of the token."""
        return self.token_sha256


@dataclass(frozen=True, slots=True, kw_only=True)
class ApiKey:
    """A machine's API key; only the SHA-256 of the secret is stored."""

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
        """Key in `AccessStore.keys`: the id."""
        return self.id


@dataclass(frozen=True, slots=True, kw_only=True)
class Attempts:
    """Number of failed log-ins for one name or address; deleted for a name by the next successful log-in."""

    subject: str
    failures: int
    last_at: datetime
    locked_until: datetime | None = None

    @property
    def key(self) -> str:
        """Key in `AccessStore.attempts`: the subject."""
        return self.subject


Record = User | Login | ApiKey | Attempts
