"""People who log in at the hospital's provider: out with a state, back with a code, in with the roles of their groups.

Nothing of what comes back is believed before the provider itself, asked by us, has said it: the browser carries a
code, and the token with the name is fetched over a connection of our own and checked.
"""

import hashlib
import unicodedata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime

from engine.errors import TidegateError
from service.access.names import NOT_IN_NAMES, check_name
from service.access.oidc_attempts import Attempt, AttemptShelf
from service.access.oidc_errors import OidcReason, OidcRefusedError, OidcUnavailableError
from service.access.oidc_provider import Known, Provider
from service.access.oidc_tokens import Claims, Expected, check_id_token
from service.access.oidc_wire import ProviderWire, authorization_url
from service.access.permissions import Role
from service.oidc_settings import OidcSettings

MAX_GROUPS = 1_000
MAX_BASE_NAME = 70
"""Leaves room within a name for what tells two people of one name apart."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Departure:
    """Where to send a person, and what the browser keeps meanwhile."""

    url: str
    browser_secret: str


@dataclass(frozen=True, slots=True, kw_only=True)
class OutsidePerson:
    """Who came back: the provider's subject is who it is, the name is how the audit calls it."""

    issuer: str
    subject: str
    name: str
    name_if_taken: str
    roles: frozenset[Role]


@dataclass(frozen=True, slots=True, kw_only=True)
class Returned:
    """What a browser brings back."""

    state: str
    code: str | None
    error: str | None
    issuer: str | None


class NoRoleError(OidcRefusedError):
    """The provider knows the person, and none of the person's groups may do anything here."""

    def __init__(self, person: OutsidePerson) -> None:
        self.person = person
        super().__init__(OidcReason.NO_ROLE, "no group of yours has a role here")


class OidcPeople:
    """Sends people out, and knows them when they come back."""

    def __init__(
        self,
        *,
        settings: OidcSettings,
        provider: Provider,
        wire: ProviderWire,
        shelf: AttemptShelf,
        now: Callable[[], datetime],
    ) -> None:
        self._settings = settings
        self._provider = provider
        self._wire = wire
        self._shelf = shelf
        self._now = now
        self._roles_of_group = settings.roles_of_group

    @property
    def is_reachable(self) -> bool:
        """Whether the provider answered when last asked."""
        return self._provider.is_reachable

    def begin(self, address: str) -> Departure:
        """Begin a log-in; from memory alone."""
        endpoints = self._known().endpoints
        attempt, browser = self._shelf.begin(address)
        url = authorization_url(
            endpoints.authorization,
            client_id=self._settings.oidc_client_id,
            verifier=attempt.verifier,
            redirect_uri=self._settings.oidc_redirect_uri,
            scope=" ".join(self._settings.oidc_scopes),
            state=attempt.state,
            nonce=attempt.nonce,
        )
        return Departure(url=url, browser_secret=browser)

    def finish(self, returned: Returned, browser: str | None) -> OutsidePerson:
        """Find out who came back; asks the provider, so for a thread that may wait.

        Raises
        ------
        OidcRefusedError
            Nothing of it is believed; NoRoleError where the person is, and may do nothing here.
        OidcUnavailableError
            The provider cannot be asked.
        """
        attempt = self._shelf.take(returned.state, browser)
        known = self._known()
        self._refuse_another_provider(returned, known)
        if returned.error is not None or not returned.code:
            raise OidcRefusedError(OidcReason.PROVIDER_REFUSED, "the provider did not let you in")
        claims = self._claims(returned.code, attempt, known)
        return self._person(claims)

    def _known(self) -> Known:
        known = self._provider.known()
        if known is None:
            self._provider.ask()
            msg = "the log-in provider does not answer"
            raise OidcUnavailableError(msg)
        return known

    def _refuse_another_provider(self, returned: Returned, known: Known) -> None:
        """See RFC 9207: a code of one provider must not be shown to another."""
        is_told = returned.issuer is not None
        if (known.endpoints.says_issuer_on_return and not is_told) or (
            is_told and returned.issuer != self._provider.issuer
        ):
            raise OidcRefusedError(OidcReason.ISSUER, "another provider sent you back")

    def _claims(self, code: str, attempt: Attempt, known: Known) -> Claims:
        tokens = self._wire.exchange(
            known.endpoints.token,
            code=code,
            verifier=attempt.verifier,
            redirect_uri=self._settings.oidc_redirect_uri,
            takes_basic=known.endpoints.takes_basic,
        )
        text, access_token = tokens.get("id_token"), tokens.get("access_token")
        if not isinstance(text, str) or not isinstance(access_token, str):
            raise OidcRefusedError(OidcReason.MALFORMED, "the provider gave no ID token beside an access token")
        try:
            return self._check(text, access_token, attempt, known)
        except OidcRefusedError as error:
            newer = None
            if error.reason is OidcReason.UNKNOWN_KEY:
                newer = self._provider.newer_than(known, self._settings.oidc_timeout_s)
            if newer is None:
                raise
            return self._check(text, access_token, attempt, newer)

    def _check(self, text: str, access_token: str, attempt: Attempt, known: Known) -> Claims:
        expected = Expected(
            issuer=self._provider.issuer,
            audience=self._settings.oidc_client_id,
            now=self._now(),
            max_skew_s=self._settings.oidc_max_clock_skew_s,
        )
        return check_id_token(text, known.keys, expected, nonce=attempt.nonce, access_token=access_token)

    def _person(self, claims: Claims) -> OutsidePerson:
        subject = claims["sub"]
        name, name_if_taken = names_of(claims.get(self._settings.oidc_name_claim), self._provider.issuer, subject)
        roles = roles_of(claims.get(self._settings.oidc_groups_claim), self._roles_of_group)
        person = OutsidePerson(
            issuer=self._provider.issuer, subject=subject, name=name, name_if_taken=name_if_taken, roles=roles
        )
        if not roles:
            raise NoRoleError(person)
        return person


def names_of(claimed: object, issuer: str, subject: str) -> tuple[str, str]:
    """Return what to call a person: as the provider does, and the same with a mark of the subject.

    Raises
    ------
    OidcRefusedError
        The provider tells no name that anybody may have.
    """
    if not isinstance(claimed, str):
        raise OidcRefusedError(OidcReason.CLAIMS, "the provider tells no name")
    name = "".join("-" if sign in NOT_IN_NAMES else sign for sign in unicodedata.normalize("NFKC", claimed)).strip()
    name = name[:MAX_BASE_NAME].strip()
    mark = hashlib.sha256(f"{issuer}\n{subject}".encode()).hexdigest()[:6]
    try:
        return check_name(name), check_name(f"{name} [{mark}]")
    except TidegateError as error:
        raise OidcRefusedError(OidcReason.CLAIMS, "the provider tells a name that nobody may have") from error


def roles_of(claimed: object, roles_of_group: Mapping[str, frozenset[Role]]) -> frozenset[Role]:
    """Unite the roles of the groups somebody is in; what is no list of names is no group."""
    groups = [claimed] if isinstance(claimed, str) else claimed
    if not isinstance(groups, list) or len(groups) > MAX_GROUPS:
        return frozenset()
    known = [roles_of_group[group] for group in groups if isinstance(group, str) and group in roles_of_group]
    return frozenset().union(*known)
