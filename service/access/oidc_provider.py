"""The outside provider as it is known here: its addresses and keys, kept in memory and renewed by a thread of its own.

Whoever asks is answered from memory at once. A token signed by a key nobody knows asks for a renewal, and waits for
none; however many such tokens come, the provider is asked at most once in `SHORTEST_S`.
"""

import logging
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from joserfc.jwk import KeySet

from engine.clock import NS_PER_S, Clock
from engine.errors import TidegateError
from service.access.oidc_errors import OidcUnavailableError
from service.access.oidc_tokens import keys_from
from service.oidc_settings import is_safe_address

SHORTEST_S = 30.0
"""Between two renewals, whatever asks for one, and whether or not they succeed."""
DISCOVERY = "/.well-known/openid-configuration"
logger = logging.getLogger(__name__)


class JsonSource(Protocol):
    """Reads JSON objects from addresses."""

    def get_json(self, address: str) -> Mapping[str, Any]:
        """Return the object, or raise OidcUnavailableError."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Endpoints:
    """Where the provider does what, as it says itself; checked."""

    authorization: str
    token: str
    jwks: str
    says_issuer_on_return: bool = False
    takes_basic: bool = True


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """What is known of the provider, and since when."""

    endpoints: Endpoints
    keys: KeySet
    at_ns: int
    generation: int


def endpoints_from(document: Mapping[str, Any], issuer: str) -> Endpoints:
    """Check the provider's description of itself; see OpenID Connect Discovery 1.0, section 4.3.

    Raises
    ------
    OidcUnavailableError
        It describes another issuer, an address that anybody could listen to, or no PKCE.
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
        takes_basic=not isinstance(ways, list) or "client_secret_basic" in ways,
        says_issuer_on_return=document.get("authorization_response_iss_parameter_supported") is True,
    )


class Provider:
    """What is known, when it is renewed, and the thread that does it."""

    def __init__(self, *, issuer: str, wire: JsonSource, clock: Clock, refresh_s: float, max_age_s: float) -> None:
        self._issuer = issuer
        self._wire = wire
        self._clock = clock
        self._refresh_s = refresh_s
        self._max_age_ns = int(max_age_s * NS_PER_S)
        self._changed = threading.Condition()
        self._known: Known | None = None
        self._tried_ns: int | None = None
        self._has_failed = False
        self._is_asked = False
        self._is_stopping = False
        self._thread = threading.Thread(target=self._run, name="oidc-keys", daemon=True)

    @property
    def issuer(self) -> str:
        """Who the provider is."""
        return self._issuer

    @property
    def is_reachable(self) -> bool:
        """Whether it answered when last asked; for the page, which decides nothing by it."""
        return self._known is not None and not self._has_failed

    def start(self) -> None:
        """Begin to renew; nothing is waited for."""
        self._thread.start()

    def stop(self) -> None:
        """End the renewing; a call under way is not waited for, its thread ends with the process."""
        with self._changed:
            self._is_stopping = True
            self._changed.notify_all()

    def known(self) -> Known | None:
        """Return what is known, None where that is nothing or too old to be believed."""
        known = self._known
        return None if known is None or self._clock.now_ns() - known.at_ns > self._max_age_ns else known

    def ask(self) -> None:
        """Ask for a renewal as soon as one may be; waits for nothing."""
        if not self._is_asked:
            with self._changed:
                self._is_asked = True
                self._changed.notify_all()

    def newer_than(self, known: Known, timeout_s: float) -> Known | None:
        """Wait for a renewal, if one may be within the time; for threads that may wait."""
        self.ask()
        if self.due_s() > timeout_s:
            return None
        with self._changed:
            self._changed.wait_for(lambda: self._is_stopping or self._generation > known.generation, timeout_s)
        found = self.known()
        return found if found is not None and found.generation > known.generation else None

    def due_s(self) -> float:
        """Return in how many seconds the provider may, and should, be asked next."""
        if self._tried_ns is None:
            return 0.0
        since_s = (self._clock.now_ns() - self._tried_ns) / NS_PER_S
        is_soon = self._is_asked or self._has_failed
        return max((SHORTEST_S if is_soon else max(self._refresh_s, SHORTEST_S)) - since_s, 0.0)

    def renew(self) -> bool:
        """Ask the provider once; on failure what is known stays."""
        self._tried_ns, self._is_asked = self._clock.now_ns(), False
        try:
            endpoints = endpoints_from(self._wire.get_json(f"{self._issuer.rstrip('/')}{DISCOVERY}"), self._issuer)
            keys = keys_from(self._wire.get_json(endpoints.jwks))
        except TidegateError as error:
            if not self._has_failed:
                logger.warning("the log-in provider cannot be used: %s", error)
            self._has_failed = True
            return False
        known = Known(endpoints=endpoints, keys=keys, at_ns=self._clock.now_ns(), generation=self._generation + 1)
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
            self._renew_whatever_comes()

    def _renew_whatever_comes(self) -> None:
        """Keep the thread alive: what no one foresaw is a failure of the provider too."""
        try:
            self.renew()
        except (ValueError, TypeError, LookupError, AttributeError, RuntimeError, OSError):
            logger.exception("the log-in provider's answer could not be read")
            self._has_failed = True
