"""Everything of the outside provider in one place: made where the site has one, asked by three routes and the door."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime

from prometheus_client import CollectorRegistry, Counter, Gauge
from sqlalchemy.exc import SQLAlchemyError

from engine.clock import Clock, MonotonicClock
from service.access.desk import AccessDesk
from service.access.logins import LOGIN, OpenedLogin
from service.access.oidc_attempts import AttemptShelf, FailureBrake
from service.access.oidc_errors import OidcReason, OidcRefusedError, OidcUnavailableError
from service.access.oidc_local import LocalLogins
from service.access.oidc_machines import OidcMachines
from service.access.oidc_people import Departure, NoRoleError, OidcPeople, OutsidePerson, Returned
from service.access.oidc_provider import Provider
from service.access.oidc_wire import ProviderWire
from service.access.records import User
from service.audit import SYSTEM, Event
from service.errors import LocalLoginRefusedError, LoginFailedError, ServiceError
from service.oidc_settings import OidcSettings

MOST_AT_ONCE = 4
"""People whom the provider is asked about at once: each holds one of the threads that also stop and hold."""
ANYBODY_S = frozenset({OidcReason.STATE, OidcReason.CODE, OidcReason.PROVIDER_REFUSED, OidcReason.ISSUER})
"""Refusals that anybody can bring about as often as they like; they are counted, not written down one by one."""
NOT_OFFERED, DISABLED, UNAVAILABLE, BUSY, STORAGE = "not_offered", "disabled", "unavailable", "busy", "storage"


@dataclass(frozen=True, slots=True, kw_only=True)
class Refusal:
    """Why somebody who came back is not let in: a word of a fixed few."""

    reason: str


class OidcDesk:
    """What the routes ask; without a provider there is nothing to ask for."""

    def __init__(
        self,
        settings: OidcSettings,
        access: AccessDesk,
        registry: CollectorRegistry,
        *,
        clock: Clock | None = None,
        now: Callable[[], datetime] = lambda: datetime.now(UTC),
    ) -> None:
        self.settings = settings
        self._access = access
        self._clock = clock or MonotonicClock()
        self._brake = FailureBrake(self._clock)
        self._seats = threading.BoundedSemaphore(MOST_AT_ONCE)
        self._local = LocalLogins(settings=settings)
        self._provider: Provider | None = None
        self._people: OidcPeople | None = None
        self._broken_glass = Counter(
            "tidegate_break_glass_logins", "Log-ins past the identity provider", registry=registry
        )
        access.logins.local_rule = self._judge_password
        if settings.oidc_issuer:
            self._open(self._clock, now, registry)

    def _open(self, clock: Clock, now: Callable[[], datetime], registry: CollectorRegistry) -> None:
        settings = self.settings
        wire = ProviderWire(
            client_id=settings.oidc_client_id,
            client_secret=settings.oidc_client_secret(),
            timeout_s=settings.oidc_timeout_s,
            ca_file=settings.oidc_ca_file,
        )
        provider = self._provider = Provider(
            issuer=settings.oidc_issuer,
            wire=wire,
            clock=clock,
            refresh_s=60.0 * settings.oidc_key_refresh_min,
            max_age_s=3600.0 * settings.oidc_max_key_age_h,
        )
        if settings.has_oidc_people:
            self._people = OidcPeople(
                settings=settings, provider=provider, wire=wire, shelf=AttemptShelf(clock), now=now
            )
        if settings.has_oidc_machines:
            self._access.doorkeeper.machine_verifier = OidcMachines(settings=settings, provider=provider, now=now)
        gauge = Gauge("tidegate_oidc_reachable", "Whether the provider answered when last asked", registry=registry)
        gauge.set_function(lambda: float(provider.is_reachable))

    @property
    def has_people(self) -> bool:
        """Whether people may log in at a provider."""
        return self._people is not None

    @property
    def is_reachable(self) -> bool:
        """Whether the provider answered when last asked."""
        return self._provider is not None and self._provider.is_reachable

    def start(self) -> None:
        """Begin to fetch keys; nothing waits for them."""
        if self._provider is not None:
            self._provider.start()

    def close(self) -> None:
        """End the fetching."""
        if self._provider is not None:
            self._provider.stop()

    def set_out(self, address: str) -> Departure | Refusal:
        """Say where to send somebody who wants to log in."""
        if self._people is None:
            return Refusal(reason=NOT_OFFERED)
        try:
            return self._people.begin(address)
        except OidcUnavailableError:
            return Refusal(reason=UNAVAILABLE)

    def come_back(self, returned: Returned, browser: str | None, address: str) -> OpenedLogin | Refusal:
        """Open a log-in for somebody who came back, or say why not; for a thread that may wait."""
        if self._brake.is_on(address) or not self._seats.acquire(blocking=False):
            return Refusal(reason=BUSY)
        try:
            return self._ask(returned, browser, address)
        finally:
            self._seats.release()

    def _ask(self, returned: Returned, browser: str | None, address: str) -> OpenedLogin | Refusal:
        if self._people is None:
            return Refusal(reason=NOT_OFFERED)
        try:
            return self._let_in(self._people.finish(returned, browser), address)
        except NoRoleError as error:
            return self._turn_away(error.person, OidcReason.NO_ROLE, address)
        except OidcRefusedError as error:
            if error.reason is OidcReason.CODE:
                self._brake.note(address)
            self._note(error.reason, address)
            return Refusal(reason=error.reason)
        except OidcUnavailableError:
            return Refusal(reason=UNAVAILABLE)
        except SQLAlchemyError:
            return Refusal(reason=STORAGE)

    def _let_in(self, person: OutsidePerson, address: str) -> OpenedLogin | Refusal:
        try:
            return self._access.logins.open_outside(
                issuer=person.issuer,
                subject=person.subject,
                name=person.name,
                name_if_taken=person.name_if_taken,
                roles=person.roles,
                address=address,
            )
        except LoginFailedError:
            return self._turn_away(person, DISABLED, address)

    def _turn_away(self, person: OutsidePerson, reason: str, address: str) -> Refusal:
        detail = {"way": "oidc", "reason": reason, "issuer": person.issuer, "subject": person.subject}
        detail["address"] = address
        # The name is the provider's word; whoever has it here may be somebody else, so it is no actor of ours.
        self._access.ledger.note(
            Event(actor=SYSTEM, action=LOGIN, outcome="refused", detail={**detail, "claimed_name": person.name})
        )
        return Refusal(reason=reason)

    def _note(self, reason: OidcReason, address: str) -> None:
        if reason in ANYBODY_S:
            self._access.ledger.count(f"log-ins at the provider refused: {reason}", address)
            return
        detail = {"way": "oidc", "reason": str(reason), "address": address}
        self._access.ledger.note(Event(actor=SYSTEM, action=LOGIN, outcome="refused", detail=detail))

    def _judge_password(self, user: User, reason: str | None) -> bool:
        """Decide on a password that was right: an ordinary one, one past the provider, or none to be used here."""
        try:
            is_break_glass = self._local.check(user, reason)
        except ServiceError as error:
            why = "local" if isinstance(error, LocalLoginRefusedError) else "no reason given"
            detail = {"way": "password", "reason": why}
            self._access.ledger.note(Event(actor=user.name, action=LOGIN, outcome="refused", detail=detail))
            raise
        if is_break_glass:
            self._broken_glass.inc()
        return is_break_glass
