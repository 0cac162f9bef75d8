"""Log-in at an OpenID Connect provider: wires its parts together where the site's settings name one."""

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Protocol

from prometheus_client import CollectorRegistry, Counter, Gauge
from sqlalchemy.exc import SQLAlchemyError

from engine.core.clock import Clock, MonotonicClock
from service.access.accounts.records import MACHINE_PREFIX, MAX_LENGTH, User
from service.access.login.logins import LOGIN, OpenedLogin
from service.access.oidc.pending_logins import FailureLimiter, PendingLogins
from service.access.oidc.people import AuthorizationRedirect, AuthorizationResponse, NoRoleError, OidcPeople, OidcUser
from service.access.oidc.provider import Provider
from service.access.oidc.refusals import TIMEOUT_S, OidcReason, OidcRefusedError, OidcUnavailableError
from service.access.request.identity import Identity
from service.access.service import AccessService
from service.core.errors import BoundError, LocalLoginRefusedError, LoginFailedError, ServiceError
from service.core.permissions import KEY_PERMISSIONS, Permission
from service.core.settings.oidc import OidcSettings
from service.storage.audit import SYSTEM, Event

if TYPE_CHECKING:
    from service.access.oidc.tokens import Claims

MAX_SCOPES = 1_000
CLIENT_CLAIMS = ("client_id", "azp", "appid")
"""Claims in which providers put the client id, in order of preference."""
SHORTEST_REASON = 8
LONGEST_REASON = 500
MAX_CONCURRENT = 4
KEY_REFRESH_S = 300.0
MAX_KEY_AGE_S = 24 * 3600.0
"""Longest use of the provider's keys while it is down."""
"""Log-ins that may wait for the provider at once: each occupies a request thread that hold and stop also need."""
COUNTED_REASONS = frozenset({OidcReason.STATE, OidcReason.CODE, OidcReason.PROVIDER_REFUSED, OidcReason.ISSUER})
"""Refusals that any client can cause at will; they are counted instead of audited one by one."""
NOT_OFFERED, DISABLED, UNAVAILABLE, BUSY, STORAGE = "not_offered", "disabled", "unavailable", "busy", "storage"


# Machines with an access token of the provider (client credentials), validated from memory without blocking.
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
        from service.access.oidc.tokens import ExpectedClaims, check_machine_token

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


def _name(claims: "Claims") -> str:
    client = next((claims[name] for name in CLIENT_CLAIMS if name in claims), None)
    longest = MAX_LENGTH - len(MACHINE_PREFIX)
    if not isinstance(client, str) or not 0 < len(client) <= longest or not client.isprintable() or client.isspace():
        raise OidcRefusedError(OidcReason.CLAIMS, f"the client's name must be 1 to {longest} printable characters")
    return f"{MACHINE_PREFIX}{client}"


# Local passwords while users log in at the provider: break-glass accounts for its outage, always audited.
class Account(Protocol):
    """The part of an account that the rule needs."""

    @property
    def is_break_glass(self) -> bool:
        """Whether the account may log in with a local password when the provider is down."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalLogins:
    """Decides whether a verified local password may be used."""

    settings: OidcSettings

    def check(self, account: Account, reason: str | None) -> bool:
        """Return whether this is a break-glass log-in, which is audited and shown.

        Raises
        ------
        LocalLoginRefusedError
            The account has to log in at the provider.
        BoundError
            The reason of a break-glass log-in is missing or out of bounds.
        """
        if not self.settings.has_oidc_people:
            return False
        if not account.is_break_glass:
            if self.settings.oidc_local_accounts == "all":
                return False
            msg = f"this account logs in with {self.settings.oidc_label}"
            raise LocalLoginRefusedError(msg, field="name", bound="a break-glass account")
        text = (reason or "").strip()
        if not SHORTEST_REASON <= len(text) <= LONGEST_REASON or not text.isprintable():
            bound = f"{SHORTEST_REASON} to {LONGEST_REASON} printable characters: why this account is used"
            msg = f"reason must be {bound}"
            raise BoundError(msg, field="reason", value="missing" if reason is None else len(text), bound=bound)
        return True


@dataclass(frozen=True, slots=True, kw_only=True)
class Refusal:
    """A refused log-in; ``reason`` is an `OidcReason` or one of this module's constants."""

    reason: str


class OidcService:
    """The provider's log-ins for the HTTP routes; without a provider in the settings every log-in is refused.

    It also sets the rule for local passwords and the verifier of machine tokens on ``access``.
    """

    def __init__(
        self,
        settings: OidcSettings,
        access: AccessService,
        registry: CollectorRegistry,
        *,
        clock: Clock | None = None,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self.settings = settings
        self._access = access
        self._clock = clock or MonotonicClock()
        self._failure_limiter = FailureLimiter(self._clock)
        self._slots = threading.BoundedSemaphore(MAX_CONCURRENT)
        self._local = LocalLogins(settings=settings)
        self._provider: Provider | None = None
        self._people: OidcPeople | None = None
        self._break_glass_logins = Counter(
            "tidegate_break_glass_logins", "Log-ins past the identity provider", registry=registry
        )
        access.logins.local_rule = self._check_local_login
        if settings.oidc_issuer:
            self._open(self._clock, now, registry)

    def _open(self, clock: Clock, now: Callable[[], datetime], registry: CollectorRegistry) -> None:
        from service.access.oidc.http_client import ProviderClient

        settings = self.settings
        client = ProviderClient(
            client_id=settings.oidc_client_id,
            client_secret=settings.oidc_client_secret(),
            timeout_s=TIMEOUT_S,
            ca_file=settings.oidc_ca_file,
        )
        provider = self._provider = Provider(
            issuer=settings.oidc_issuer,
            client=client,
            clock=clock,
            refresh_s=KEY_REFRESH_S,
            max_age_s=MAX_KEY_AGE_S,
        )
        if settings.has_oidc_people:
            self._people = OidcPeople(
                settings=settings, provider=provider, client=client, pending=PendingLogins(clock), now=now
            )
        if settings.has_oidc_machines:
            self._access.authenticator.machine_verifier = OidcMachines(settings=settings, provider=provider, now=now)
        gauge = Gauge("tidegate_oidc_reachable", "Whether the provider answered when last asked", registry=registry)
        gauge.set_function(lambda: float(provider.is_reachable))

    @property
    def has_people(self) -> bool:
        """Whether users may log in at a provider."""
        return self._people is not None

    @property
    def is_reachable(self) -> bool:
        """Whether the provider answered the newest refresh; False without a provider."""
        return self._provider is not None and self._provider.is_reachable

    def start(self) -> None:
        """Start fetching the provider's keys in the background."""
        if self._provider is not None:
            self._provider.start()

    def close(self) -> None:
        """Stop fetching keys; a call in progress is not waited for."""
        if self._provider is not None:
            self._provider.stop()

    def begin_login(self, address: str) -> AuthorizationRedirect | Refusal:
        """Return the redirect to the provider; from memory, without blocking."""
        if self._people is None:
            return Refusal(reason=NOT_OFFERED)
        try:
            return self._people.begin(address)
        except OidcUnavailableError:
            return Refusal(reason=UNAVAILABLE)

    def finish_login(self, returned: AuthorizationResponse, browser: str | None, address: str) -> OpenedLogin | Refusal:
        """Open a log-in for a provider's response, or return why not; blocks on the provider."""
        if self._failure_limiter.is_limited(address) or not self._slots.acquire(blocking=False):
            return Refusal(reason=BUSY)
        try:
            return self._finish(returned, browser, address)
        finally:
            self._slots.release()

    def _finish(self, returned: AuthorizationResponse, browser: str | None, address: str) -> OpenedLogin | Refusal:
        if self._people is None:
            return Refusal(reason=NOT_OFFERED)
        try:
            return self._open_login(self._people.finish(returned, browser), address)
        except NoRoleError as error:
            return self._refuse(error.person, OidcReason.NO_ROLE, address)
        except OidcRefusedError as error:
            if error.reason is OidcReason.CODE:
                self._failure_limiter.record(address)
            self._note(error.reason, address)
            return Refusal(reason=error.reason)
        except OidcUnavailableError:
            return Refusal(reason=UNAVAILABLE)
        except SQLAlchemyError:
            return Refusal(reason=STORAGE)

    def _open_login(self, person: OidcUser, address: str) -> OpenedLogin | Refusal:
        try:
            return self._access.logins.open_oidc(
                issuer=person.issuer,
                subject=person.subject,
                name=person.name,
                name_if_taken=person.name_if_taken,
                roles=person.roles,
                address=address,
            )
        except LoginFailedError:
            return self._refuse(person, DISABLED, address)

    def _refuse(self, person: OidcUser, reason: str, address: str) -> Refusal:
        detail = {"way": "oidc", "reason": reason, "issuer": person.issuer, "subject": person.subject}
        detail["address"] = address
        # The claimed name may belong to another local account, so it is not recorded as the actor.
        self._access.refused_logins.record(
            Event(actor=SYSTEM, action=LOGIN, outcome="refused", detail={**detail, "claimed_name": person.name})
        )
        return Refusal(reason=reason)

    def _note(self, reason: OidcReason, address: str) -> None:
        if reason in COUNTED_REASONS:
            self._access.refused_logins.count(f"log-ins at the provider refused: {reason}", address)
            return
        detail = {"way": "oidc", "reason": str(reason), "address": address}
        self._access.refused_logins.record(Event(actor=SYSTEM, action=LOGIN, outcome="refused", detail=detail))

    def _check_local_login(self, user: User, reason: str | None) -> bool:
        """Whether a log-in with a verified password is break-glass; audit a refusal and raise it."""
        try:
            is_break_glass = self._local.check(user, reason)
        except ServiceError as error:
            why = "local" if isinstance(error, LocalLoginRefusedError) else "no reason given"
            detail = {"way": "password", "reason": why}
            self._access.refused_logins.record(Event(actor=user.name, action=LOGIN, outcome="refused", detail=detail))
            raise
        if is_break_glass:
            self._break_glass_logins.inc()
        return is_break_glass
