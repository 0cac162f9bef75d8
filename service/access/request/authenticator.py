"""Authenticates a request by its headers, from memory alone: no database, no argon2, some microseconds."""

from datetime import datetime, timedelta

from starlette.datastructures import Headers

from service.access.accounts.records import KEY_PREFIX, MACHINE_PREFIX, ApiKey, Login, name_key
from service.access.accounts.store import AccessStore
from service.access.login.cookies import CookieScope, screen_token_in, token_in
from service.access.login.keys import TOKEN_PREFIX, KeyService, actor_of
from service.access.login.logins import hashed
from service.access.request.identity import Identity, MachineVerifier
from service.access.screens.screens import Screen, ScreenService
from service.core.permissions import KEY_PERMISSIONS, Permission, permissions_of

LONGEST_TOKEN = 16_384

MOST_MACHINES = 1_000
"""Beyond so many machines, those whose tokens have expired are forgotten."""


class Authenticator:
    """Maps cookies, API keys and machine tokens to identities; called from any thread.

    ``machine_verifier`` is set by `service.access.oidc` where the site accepts the provider's machine tokens.
    """

    def __init__(
        self, store: AccessStore, keys: KeyService, screens: ScreenService, *, idle: timedelta, cookies: CookieScope
    ) -> None:
        self._store = store
        self._screens = screens
        self._keys = keys
        self._idle = idle
        self._cookies = cookies
        self.machine_verifier: MachineVerifier | None = None
        self._machines_until: dict[str, datetime] = {}

    def identify(self, headers: Headers) -> Identity | None:
        """Return the sender, None if unauthenticated; with an Authorization header the cookie is not read."""
        authorization = headers.get("authorization")
        if authorization is not None:
            return self._bearer(authorization)
        token = token_in(headers, self._cookies)
        return None if token is None else self._person(hashed(token))

    def identify_watcher(self, headers: Headers) -> Identity | None:
        """Return who watches the coaching stream: a paired screen before a log-in in the same browser.

        The screen's cookie is read here alone; on every other route it is nothing.
        """
        token = screen_token_in(headers, self._cookies)
        screen = None if token is None else self._screens.find(hashed(token))
        return self.identify(headers) if screen is None else _screen_identity(screen)

    def is_valid(self, identity: Identity) -> bool:
        """Whether an identity is still valid with all its permissions; for open WebSockets and event streams."""
        if identity.kind == "screen":
            return self._screens.find(identity.anchor or "") is not None
        if identity.until is not None and self._store.now() >= identity.until:
            return False
        if identity.kind == "key":
            return identity.anchor is not None and self._keys.is_valid(identity.anchor)
        if not identity.is_person or identity.anchor is None:
            return True
        now = self._person(identity.anchor)
        return now is not None and identity.permissions <= now.permissions

    def is_present(self, actor: str) -> bool:
        """Whether an audit's actor could still hold or disarm, from any browser; does not count as use of a log-in.

        A machine with tokens of the identity provider is present until the last of them that it sent expires.
        """
        if actor.startswith(KEY_PREFIX):
            keys = tuple(self._store.keys.values())
            return any(actor_of(key) == actor and self._keys.is_valid(key.id) for key in keys)
        if actor.startswith(MACHINE_PREFIX):
            until = self._machines_until.get(actor)
            return until is not None and self._store.now() < until
        user = self._store.users.get(name_key(actor))
        if user is None:
            return False
        may_arm = Permission.GATE_ARM in permissions_of(user.roles)
        return may_arm and any(self._is_open(login) for login in self._store.logins_of(user))

    def login_of(self, identity: Identity) -> Login | None:
        """Return the log-in that authenticated an identity; None for machines and ended log-ins."""
        return self._store.logins.get(identity.anchor or "")

    def _bearer(self, authorization: str) -> Identity | None:
        scheme, _, token = authorization.partition(" ")
        token = token.strip()
        if scheme.lower() != "bearer" or not token or len(token) > LONGEST_TOKEN:
            return None
        if token.startswith(TOKEN_PREFIX):
            key = self._keys.find(token)
            return None if key is None else self._machine(key)
        machine = None if self.machine_verifier is None else self.machine_verifier.identify(token)
        if machine is not None and machine.until is not None:
            self._note_machine(machine.name, machine.until)
        return machine

    def _note_machine(self, name: str, until: datetime) -> None:
        """Keep until when a machine's newest token is valid; tokens may arrive in any order."""
        known = self._machines_until
        if len(known) >= MOST_MACHINES and name not in known:
            now = self._store.now()
            known = {one: end for one, end in known.items() if end > now}
        self._machines_until = known | {name: max(until, known.get(name, until))}

    def _machine(self, key: ApiKey) -> Identity:
        self._store.last_used[key.id] = self._store.now()
        # A key that was stored by an earlier version may have a scope that machines no longer have.
        return Identity(kind="key", name=actor_of(key), permissions=key.scopes & KEY_PERMISSIONS, anchor=key.id)

    def _person(self, token_sha256: str) -> Identity | None:
        login = self._store.logins.get(token_sha256)
        if login is None:
            return None
        if not self._is_open(login):
            return None
        user = self._store.users[login.user_key]
        self._store.last_used[token_sha256] = self._store.now()
        return Identity(
            kind="user" if user.issuer is None else "oidc",
            name=user.name,
            permissions=permissions_of(user.roles),
            anchor=token_sha256,
            must_change_password=user.must_change_password,
        )

    def _is_open(self, login: Login) -> bool:
        now = self._store.now()
        is_disabled = self._store.users[login.user_key].is_disabled
        return not is_disabled and now < login.expires_at and now - self._store.last_used_at(login) <= self._idle


def _screen_identity(screen: Screen) -> Identity:
    return Identity(
        kind="screen",
        name=f"screen:{screen.number}",
        permissions=frozenset({Permission.COACH_WATCH}),
        anchor=screen.token_sha256,
        until=screen.expires_at,
    )
