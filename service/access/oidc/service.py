"""Log-in at an OpenID Connect provider: wires its parts together where the site's settings name one."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

from prometheus_client import CollectorRegistry, Counter, Gauge
from sqlalchemy.exc import SQLAlchemyError

from engine.core.clock import Clock, MonotonicClock
from service.access.accounts.records import User
from service.access.login.logins import LOGIN, OpenedLogin
from service.access.oidc.errors import OidcReason, OidcRefusedError, OidcUnavailableError
from service.access.oidc.http_client import ProviderClient
from service.access.oidc.local_passwords import LocalLogins
from service.access.oidc.machines import OidcMachines
from service.access.oidc.pending_logins import FailureLimiter, PendingLogins
from service.access.oidc.people import AuthorizationRedirect, AuthorizationResponse, NoRoleError, OidcPeople, OidcUser
from service.access.oidc.provider import Provider
from service.access.service import AccessService
from service.core.errors import LocalLoginRefusedError, LoginFailedError, ServiceError
from service.core.settings.oidc import OidcSettings
from service.storage.audit import SYSTEM, Event

MAX_CONCURRENT = 4
"""Log-ins that may wait for the provider at once: each occupies a request thread that hold and stop also need."""
COUNTED_REASONS = frozenset({OidcReason.STATE, OidcReason.CODE, OidcReason.PROVIDER_REFUSED, OidcReason.ISSUER})
"""Refusals that any client can cause at will; they are counted instead of audited one by one."""
NOT_OFFERED, DISABLED, UNAVAILABLE, BUSY, STORAGE = "not_offered", "disabled", "unavailable", "busy", "storage"


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
        settings = self.settings
        client = ProviderClient(
            client_id=settings.oidc_client_id,
            client_secret=settings.oidc_client_secret(),
            timeout_s=settings.oidc_timeout_s,
            ca_file=settings.oidc_ca_file,
        )
        provider = self._provider = Provider(
            issuer=settings.oidc_issuer,
            client=client,
            clock=clock,
            refresh_s=60.0 * settings.oidc_key_refresh_min,
            max_age_s=3600.0 * settings.oidc_max_key_age_h,
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
