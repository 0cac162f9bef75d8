"""Machines with an access token of the provider (client credentials), validated from memory without blocking."""

from collections.abc import Callable, Mapping
from datetime import UTC, datetime

from service.access.accounts.names import MACHINE_PREFIX, MAX_LENGTH
from service.access.oidc.errors import OidcReason, OidcRefusedError
from service.access.oidc.provider import Provider
from service.access.oidc.tokens import Claims, ExpectedClaims, check_machine_token
from service.access.request.identity import Identity
from service.core.permissions import KEY_PERMISSIONS, Permission
from service.core.settings.oidc import OidcSettings

MAX_SCOPES = 1_000
CLIENT_CLAIMS = ("client_id", "azp", "appid")
"""Claims in which providers put the client id, in order of preference."""


class OidcMachines:
    """Maps access tokens to machine identities, with the permissions of their scopes."""

    def __init__(self, *, settings: OidcSettings, provider: Provider, now: Callable[[], datetime]) -> None:
        self._settings = settings
        self._provider = provider
        self._now = now
        self._permissions_of_scope = settings.permissions_of_scope

    def identify(self, token: str) -> Identity | None:
        """Return the machine's identity, None if the token is refused; an unknown key requests a key refresh."""
        try:
            return self.check(token)
        except OidcRefusedError as error:
            if error.reason is OidcReason.UNKNOWN_KEY:
                self._provider.request_refresh()
            return None

    def check(self, token: str) -> Identity:
        """Validate an access token and return the machine's identity, valid until the token expires.

        Raises
        ------
        OidcRefusedError
            The token is not valid, or none of its scopes has a permission here.
        """
        provider = self._provider.state()
        if provider is None:
            raise OidcRefusedError(OidcReason.UNKNOWN_KEY, "the provider's keys are not known, or too old")
        expected = ExpectedClaims(
            issuer=self._provider.issuer,
            audience=self._settings.oidc_machine_audience,
            now=self._now(),
            max_skew_s=self._settings.oidc_max_clock_skew_s,
        )
        claims = check_machine_token(token, provider.keys, expected, types=self._settings.oidc_machine_types)
        permissions = permissions_of(claims.get(self._settings.oidc_machine_scope_claim), self._permissions_of_scope)
        if not permissions:
            raise OidcRefusedError(OidcReason.SCOPE, "no scope of the token may do anything here")
        until = datetime.fromtimestamp(claims["exp"] + self._settings.oidc_max_clock_skew_s, UTC)
        return Identity(kind="machine", name=_name(claims), permissions=permissions, until=until)


def permissions_of(claimed: object, permissions_of_scope: Mapping[str, frozenset[Permission]]) -> frozenset[Permission]:
    """Return the union of the scopes' permissions, within what machines may have; unknown scopes are ignored."""
    scopes = claimed.split() if isinstance(claimed, str) else claimed
    if not isinstance(scopes, list) or len(scopes) > MAX_SCOPES:
        return frozenset()
    granted = [permissions_of_scope[one] for one in scopes if isinstance(one, str) and one in permissions_of_scope]
    return frozenset().union(*granted) & KEY_PERMISSIONS


def _name(claims: Claims) -> str:
    client = next((claims[name] for name in CLIENT_CLAIMS if name in claims), None)
    longest = MAX_LENGTH - len(MACHINE_PREFIX)
    if not isinstance(client, str) or not 0 < len(client) <= longest or not client.isprintable() or client.isspace():
        raise OidcRefusedError(OidcReason.CLAIMS, f"the client's name must be 1 to {longest} printable characters")
    return f"{MACHINE_PREFIX}{client}"
