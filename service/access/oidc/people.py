"""User log-in by the authorisation code flow: redirect with state, response with code, roles from the groups claim.

Nothing in the browser's response is trusted: it only carries a code, which is exchanged for an ID token over a separate
TLS connection to the provider; the token is then validated.
"""

import hashlib
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

from engine.core.errors import TidegateError
from service.access.accounts.records import NOT_IN_NAMES, check_name
from service.access.oidc.pending_logins import PendingLogin, PendingLogins
from service.access.oidc.provider import Provider, ProviderState
from service.access.oidc.refusals import TIMEOUT_S, OidcReason, OidcRefusedError, OidcUnavailableError
from service.core.permissions import Role
from service.core.settings.oidc import OidcSettings

# Fifteen megabytes of libraries, imported where a site's settings name a provider.
if TYPE_CHECKING:
    from service.access.oidc.http_client import ProviderClient
    from service.access.oidc.tokens import Claims

MAX_GROUPS = 1_000
MAX_BASE_NAME = 70
"""Leaves room in a name for the mark that distinguishes two users of one name."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AuthorizationRedirect:
    """The URL to redirect the browser to, and the secret for its cookie."""

    url: str
    browser_secret: str


@dataclass(frozen=True, slots=True, kw_only=True)
class OidcUser:
    """A user authenticated by the provider: issuer and subject identify them, the name is for display and audit."""

    issuer: str
    subject: str
    name: str
    name_if_taken: str
    roles: frozenset[Role]


@dataclass(frozen=True, slots=True, kw_only=True)
class AuthorizationResponse:
    """The query parameters of the provider's redirect back; each of them can be forged."""

    state: str
    code: str | None
    error: str | None
    issuer: str | None


class NoRoleError(OidcRefusedError):
    """The provider authenticated the user, but none of the user's groups has a role here."""

    code = OidcRefusedError.code

    def __init__(self, person: OidcUser) -> None:
        self.person = person
        super().__init__(OidcReason.NO_ROLE, "no group of yours has a role here")


class OidcPeople:
    """Begins and finishes log-ins of users at the provider."""

    def __init__(
        self,
        *,
        settings: OidcSettings,
        provider: Provider,
        client: "ProviderClient",
        pending: PendingLogins,
        now: Callable[[], datetime],
    ) -> None:
        self._settings = settings
        self._provider = provider
        self._client = client
        self._pending = pending
        self._now = now
        self._roles_of_group = settings.roles_of_group

    @property
    def is_reachable(self) -> bool:
        """Whether the provider's newest refresh succeeded."""
        return self._provider.is_reachable

    def begin(self, address: str) -> AuthorizationRedirect:
        """Begin a log-in from memory; raise OidcUnavailableError if the provider's state is missing or too old."""
        from service.access.oidc.http_client import authorization_url

        endpoints = self._known().endpoints
        attempt, browser = self._pending.begin(address)
        url = authorization_url(
            endpoints.authorization,
            client_id=self._settings.oidc_client_id,
            verifier=attempt.verifier,
            redirect_uri=self._settings.oidc_redirect_uri,
            scope=" ".join(self._settings.oidc_scopes),
            state=attempt.state,
            nonce=attempt.nonce,
        )
        return AuthorizationRedirect(url=url, browser_secret=browser)

    def finish(self, returned: AuthorizationResponse, browser: str | None) -> OidcUser:
        """Exchange the code and return the authenticated user; blocks on the provider.

        Raises
        ------
        OidcRefusedError
            The response or the token is not valid; NoRoleError if the user is valid but has no role.
        OidcUnavailableError
            The provider cannot be reached.
        """
        attempt = self._pending.take(returned.state, browser)
        known = self._known()
        self._refuse_other_issuer(returned, known)
        if returned.error is not None or not returned.code:
            raise OidcRefusedError(OidcReason.PROVIDER_REFUSED, "the provider did not let you in")
        claims = self._claims(returned.code, attempt, known)
        return self._person(claims)

    def _known(self) -> ProviderState:
        known = self._provider.state()
        if known is None:
            self._provider.request_refresh()
            msg = "the log-in provider does not answer"
            raise OidcUnavailableError(msg)
        return known

    def _refuse_other_issuer(self, returned: AuthorizationResponse, known: ProviderState) -> None:
        """Check the ``iss`` parameter (RFC 9207): a code of one provider must not be sent to another."""
        has_issuer = returned.issuer is not None
        if (known.endpoints.sends_issuer and not has_issuer) or (
            has_issuer and returned.issuer != self._provider.issuer
        ):
            raise OidcRefusedError(OidcReason.ISSUER, "another provider sent you back")

    def _claims(self, code: str, attempt: PendingLogin, known: ProviderState) -> "Claims":
        tokens = self._client.exchange(
            known.endpoints.token,
            code=code,
            verifier=attempt.verifier,
            redirect_uri=self._settings.oidc_redirect_uri,
            accepts_basic=known.endpoints.accepts_basic,
        )
        text, access_token = tokens.get("id_token"), tokens.get("access_token")
        if not isinstance(text, str) or not isinstance(access_token, str):
            raise OidcRefusedError(OidcReason.MALFORMED, "the provider gave no ID token beside an access token")
        try:
            return self._check(text, access_token, attempt, known)
        except OidcRefusedError as error:
            newer = None
            if error.reason is OidcReason.UNKNOWN_KEY:
                newer = self._provider.newer_than(known, TIMEOUT_S)
            if newer is None:
                raise
            return self._check(text, access_token, attempt, newer)

    def _check(self, text: str, access_token: str, attempt: PendingLogin, known: ProviderState) -> "Claims":
        from service.access.oidc.tokens import ExpectedClaims, check_id_token

        expected = ExpectedClaims(
            issuer=self._provider.issuer,
            audience=self._settings.oidc_client_id,
            now=self._now(),
            max_skew_s=self._settings.oidc_max_clock_skew_s,
        )
        return check_id_token(text, known.keys, expected, nonce=attempt.nonce, access_token=access_token)

    def _person(self, claims: "Claims") -> OidcUser:
        subject = claims["sub"]
        name, name_if_taken = names_of(claims.get(self._settings.oidc_name_claim), self._provider.issuer, subject)
        roles = roles_of(claims.get(self._settings.oidc_groups_claim), self._roles_of_group)
        person = OidcUser(
            issuer=self._provider.issuer, subject=subject, name=name, name_if_taken=name_if_taken, roles=roles
        )
        if not roles:
            raise NoRoleError(person)
        return person


def names_of(claimed: object, issuer: str, subject: str) -> tuple[str, str]:
    """Return the provider's name for a user, and the same name with a short hash of the subject, for when it is taken.

    Raises
    ------
    OidcRefusedError
        The name claim is missing or not an allowed name.
    """
    if not isinstance(claimed, str):
        raise OidcRefusedError(OidcReason.CLAIMS, "the provider sends no name")
    name = "".join("-" if sign in NOT_IN_NAMES else sign for sign in unicodedata.normalize("NFKC", claimed)).strip()
    name = name[:MAX_BASE_NAME].strip()
    mark = hashlib.sha256(f"{issuer}\n{subject}".encode()).hexdigest()[:6]
    try:
        return check_name(name), check_name(f"{name} [{mark}]")
    except TidegateError as error:
        raise OidcRefusedError(OidcReason.CLAIMS, "the provider sends a name that is not allowed") from error


def roles_of(claimed: object, roles_of_group: Mapping[str, frozenset[Role]]) -> frozenset[Role]:
    """Return the union of the groups' roles; empty if the claim is not a string or a list."""
    groups = [claimed] if isinstance(claimed, str) else claimed
    if not isinstance(groups, list) or len(groups) > MAX_GROUPS:
        return frozenset()
    granted = [roles_of_group[group] for group in groups if isinstance(group, str) and group in roles_of_group]
    return frozenset().union(*granted)
