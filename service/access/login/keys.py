"""API keys for machines: ``tg_<id>_<secret>``; the secret is shown once and stored as SHA-256, the life is bounded."""

import hmac
import secrets
from collections.abc import Iterable
from dataclasses import dataclass, replace
from datetime import datetime, timedelta

from service.access.accounts.records import KEY_PREFIX, ApiKey, check_name, is_like
from service.access.accounts.store import AccessStore
from service.access.login.logins import TOKEN_BYTES, hashed
from service.core.errors import BoundError, NameTakenError, NotFoundError
from service.core.permissions import KEY_PERMISSIONS, Permission
from service.storage.audit import Event

CREATE = "key.create"
REVOKE = "key.revoke"
TOKEN_PREFIX = "tg_"  # noqa: S105 - the prefix of every key
ID_BYTES = 6
LONGEST_NAME = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class CreatedKey:
    """A newly created key and its full secret, which is not stored; ``repr`` omits the secret."""

    key: ApiKey
    secret: str

    def __repr__(self) -> str:
        return f"CreatedKey(key={self.key.id!r})"


class KeyService:
    """Creates, finds and revokes API keys.

    Parameters
    ----------
    longest
        Longest allowed life of a key.
    """

    def __init__(self, store: AccessStore, *, longest: timedelta) -> None:
        self._store = store
        self._longest = longest

    def all(self) -> list[ApiKey]:
        """List all keys, revoked ones too, newest first, with the current time of last use."""
        keys = sorted(self._store.keys.values(), key=lambda key: key.created_at, reverse=True)
        return [replace(key, last_used_at=self._store.last_used.get(key.id, key.last_used_at)) for key in keys]

    def create(self, name: str, scopes: Iterable[Permission], expires_at: datetime, *, by: str) -> CreatedKey:
        """Create a key and audit it.

        Raises
        ------
        BoundError
            Name, scopes or expiry are outside their bounds.
        NameTakenError
            A key has, or had, this name.
        """
        _check_key_name(name)
        chosen = _check_scopes(scopes)
        self._check_expiry(expires_at)
        secret = secrets.token_urlsafe(TOKEN_BYTES)
        key = ApiKey(
            id=secrets.token_hex(ID_BYTES),
            name=name,
            secret_sha256=hashed(secret),
            scopes=chosen,
            created_by=by,
            created_at=self._store.wall(),
            expires_at=expires_at,
        )
        detail = {"key_id": key.id, "key": name, "scopes": sorted(chosen), "expires_at": expires_at.isoformat()}
        with self._store.changing:
            if any(is_like(other.name, name) for other in self._store.keys.values()):
                msg = "this name is or was a key's: names in the audit must be unique"
                raise NameTakenError(msg, field="name", value=name, bound="a name that no key had")
            self._store.write(save=[key], event=Event(actor=by, action=CREATE, detail=detail))
        return CreatedKey(key=key, secret=f"{TOKEN_PREFIX}{key.id}_{secret}")

    def find_id(self, key_id: str) -> ApiKey:
        """Return a key by its id, with the current time of last use; raise NotFoundError if there is none."""
        key = self._store.keys.get(key_id)
        if key is None:
            msg = "there is no such key"
            raise NotFoundError(msg, field="key_id", value=key_id)
        return replace(key, last_used_at=self._store.last_used.get(key.id, key.last_used_at))

    def revoke(self, key_id: str, *, by: str) -> ApiKey:
        """Revoke a key permanently; idempotent. Raise NotFoundError if there is none."""
        with self._store.changing:
            key = self._store.keys.get(key_id)
            if key is None:
                msg = "there is no such key"
                raise NotFoundError(msg, field="key_id", value=key_id)
            if key.revoked_at is None:
                key = replace(key, revoked_at=self._store.wall())
                detail = {"key_id": key.id, "key": key.name}
                self._store.write(save=[key], event=Event(actor=by, action=REVOKE, detail=detail))
        return key

    def find(self, token: str) -> ApiKey | None:
        """Return the key of a token; None if it is unknown, expired or revoked."""
        key_id, _, secret = token.removeprefix(TOKEN_PREFIX).partition("_")
        key = self._store.keys.get(key_id)
        if key is None or not hmac.compare_digest(key.secret_sha256, hashed(secret)):
            return None
        return key if self.is_valid(key.id) else None

    def is_valid(self, key_id: str) -> bool:
        """Whether a key exists and is neither revoked nor expired."""
        key = self._store.keys.get(key_id)
        return key is not None and key.revoked_at is None and key.expires_at > self._store.wall()

    def _check_expiry(self, expires_at: datetime) -> None:
        now = self._store.wall()
        if not now < expires_at <= now + self._longest:
            bound = f"later than now, and at most {self._longest.days} days from now"
            msg = f"expires_at must be {bound}"
            raise BoundError(msg, field="expires_at", value=expires_at.isoformat(), bound=bound)


def actor_of(key: ApiKey) -> str:
    """Return the audit's actor of a key; its prefix is not allowed in names of persons."""
    return f"{KEY_PREFIX}{key.name}"


def _check_key_name(name: str) -> None:
    if len(check_name(name)) > LONGEST_NAME:
        bound = f"at most {LONGEST_NAME} characters"
        raise BoundError(f"name must be {bound}", field="name", value=name, bound=bound)


def _check_scopes(scopes: Iterable[Permission]) -> frozenset[Permission]:
    chosen = frozenset(scopes)
    if not chosen or not chosen <= KEY_PERMISSIONS:
        bound = f"at least one of {', '.join(sorted(KEY_PERMISSIONS))}"
        value = ", ".join(sorted(chosen - KEY_PERMISSIONS)) or "none"
        raise BoundError(f"scopes must be {bound}", field="scopes", value=value, bound=bound)
    return chosen
