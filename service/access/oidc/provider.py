"""The provider's endpoints and keys, kept in memory and refreshed by a background thread.

Reads return from memory at once. A token with an unknown key requests a refresh but does not wait for it; however many
such tokens arrive, the provider is called at most once per `MIN_INTERVAL_S`.
"""

import logging
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from engine.core.clock import NS_PER_S, Clock
from engine.core.errors import TidegateError
from service.access.oidc.refusals import OidcUnavailableError
from service.core.settings.oidc import is_safe_address

if TYPE_CHECKING:
    from joserfc.jwk import KeySet

MIN_INTERVAL_S = 30.0
"""Shortest time between two refreshes, successful or not."""
DISCOVERY = "/.well-known/openid-configuration"
logger = logging.getLogger(__name__)


class JsonSource(Protocol):
    """Fetches JSON objects over HTTP."""

    def get_json(self, address: str) -> Mapping[str, Any]:
        """Return the object at an address; raise OidcUnavailableError if it cannot be fetched."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoints:
    """The provider's endpoints from its discovery document, validated."""

    authorization: str
    token: str
    jwks: str
    sends_issuer: bool = False
    accepts_basic: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class ProviderState:
    """Endpoints and keys of one refresh, its monotonic time [ns], and a number that each refresh increments."""

    endpoints: Endpoints
    keys: "KeySet"
    at_ns: int
    generation: int


def endpoints_from(document: Mapping[str, Any], issuer: str) -> Endpoints:
    """Validate the discovery document (OpenID Connect Discovery 1.0, section 4.3).

    Raises
    ------
    OidcUnavailableError
        It names another issuer, an endpoint without https, or no PKCE with SHA-256.
    """
    if document.get("issuer") != issuer:
        msg = "the provider describes itself as another issuer than the site has set"
        raise OidcUnavailableError(msg)
    found = {}
    for name in ("authorization_endpoint", "token_endpoint", "jwks_uri"):
        address = document.get(name)
        if not isinstance(address, str) or not is_safe_address(address.partition("?")[0]) or "#" in address:
            msg = f"the provider's {name} is no https address"
            raise OidcUnavailableError(msg)
        if issuer.startswith("https:") and not address.startswith("https:"):
            msg = f"the provider's {name} is not https although the provider is"
            raise OidcUnavailableError(msg)
        found[name] = address
    methods = document.get("code_challenge_methods_supported", ["S256"])
    if not isinstance(methods, list) or "S256" not in methods:
        msg = "the provider supports no PKCE by SHA-256"
        raise OidcUnavailableError(msg)
    ways = document.get("token_endpoint_auth_methods_supported", ["client_secret_basic"])
    return Endpoints(
        authorization=found["authorization_endpoint"],
        token=found["token_endpoint"],
        jwks=found["jwks_uri"],
        accepts_basic=not isinstance(ways, list) or "client_secret_basic" in ways,
        sends_issuer=document.get("authorization_response_iss_parameter_supported") is True,
    )


class Provider:
    """Keeps the provider's state fresh; reads from any thread.

    Parameters
    ----------
    refresh_s
        Time between two refreshes while all is well [s].
    max_age_s
        State older than this is not used [s].
    """

    def __init__(self, *, issuer: str, client: JsonSource, clock: Clock, refresh_s: float, max_age_s: float) -> None:
        self._issuer = issuer
        self._client = client
        self._clock = clock
        self._refresh_s = refresh_s
        self._max_age_ns = int(max_age_s * NS_PER_S)
        self._changed = threading.Condition()
        self._known: ProviderState | None = None
        self._tried_ns: int | None = None
        self._has_failed = False
        self._is_refresh_requested = False
        self._is_stopping = False
        self._thread = threading.Thread(target=self._run, name="oidc-keys", daemon=True)

    @property
    def issuer(self) -> str:
        """The issuer URL from the settings."""
        return self._issuer

    @property
    def is_reachable(self) -> bool:
        """Whether the newest refresh succeeded; for display only."""
        return self._known is not None and not self._has_failed

    def start(self) -> None:
        """Start the refresh thread; does not wait for the first refresh."""
        self._thread.start()

    def stop(self) -> None:
        """Stop the refresh thread without waiting for a call in progress; the thread is a daemon."""
        with self._changed:
            self._is_stopping = True
            self._changed.notify_all()

    def state(self) -> ProviderState | None:
        """Return the newest state; None if there is none yet or it is older than the maximum age."""
        known = self._known
        return None if known is None or self._clock.now_ns() - known.at_ns > self._max_age_ns else known

    def request_refresh(self) -> None:
        """Request a refresh at the earliest allowed time; does not wait."""
        if not self._is_refresh_requested:
            with self._changed:
                self._is_refresh_requested = True
                self._changed.notify_all()

    def newer_than(self, known: ProviderState, timeout_s: float) -> ProviderState | None:
        """Wait up to ``timeout_s`` for a newer state; None if none comes, at once if no refresh is due in that time."""
        self.request_refresh()
        if self.due_s() > timeout_s:
            return None
        with self._changed:
            self._changed.wait_for(lambda: self._is_stopping or self._generation > known.generation, timeout_s)
        found = self.state()
        return found if found is not None and found.generation > known.generation else None

    def due_s(self) -> float:
        """Return the time to the next refresh [s]; 0 if it is due."""
        if self._tried_ns is None:
            return 0.0
        since_s = (self._clock.now_ns() - self._tried_ns) / NS_PER_S
        is_soon = self._is_refresh_requested or self._has_failed
        return max((MIN_INTERVAL_S if is_soon else max(self._refresh_s, MIN_INTERVAL_S)) - since_s, 0.0)

    def refresh(self) -> bool:
        """Fetch endpoints and keys once; return whether that succeeded. On failure the former state is kept."""
        from service.access.oidc.tokens import keys_from

        self._tried_ns, self._is_refresh_requested = self._clock.now_ns(), False
        try:
            endpoints = endpoints_from(self._client.get_json(f"{self._issuer.rstrip('/')}{DISCOVERY}"), self._issuer)
            keys = keys_from(self._client.get_json(endpoints.jwks))
        except TidegateError as error:
            if not self._has_failed:
                logger.warning("the log-in provider cannot be used: %s", error)
            self._has_failed = True
            return False
        known = ProviderState(
            endpoints=endpoints, keys=keys, at_ns=self._clock.now_ns(), generation=self._generation + 1
        )
        with self._changed:
            self._known, self._has_failed = known, False
            self._changed.notify_all()
        return True

    @property
    def _generation(self) -> int:
        return 0 if self._known is None else self._known.generation

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._is_stopping and (due_s := self.due_s()) > 0.0:
                    self._changed.wait(due_s)
                if self._is_stopping:
                    return
            self._refresh_safely()

    def _refresh_safely(self) -> None:
        """Refresh; treat an unexpected error as a failure of the provider, so that the thread goes on."""
        try:
            self.refresh()
        except (ValueError, TypeError, LookupError, AttributeError, RuntimeError, OSError):
            logger.exception("the log-in provider's answer could not be read")
            self._has_failed = True
