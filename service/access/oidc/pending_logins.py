"""Log-ins redirected to the provider and not yet completed: valid for five minutes, once, for one browser."""

import hashlib
import hmac
import secrets
import threading
from collections import OrderedDict, deque
from dataclasses import dataclass

from engine.core.clock import NS_PER_S, Clock
from service.access.oidc.refusals import OidcReason, OidcRefusedError

LIFE_S = 300.0
MAX_PENDING = 4_096
MAX_PER_ADDRESS = 64
"""Pending log-ins of one address; beyond it that address's oldest is dropped, never another's."""
MAX_FAILURES = 20
"""Codes refused by the provider from one address within `LIFE_S`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PendingLogin:
    """State, nonce and PKCE verifier of one log-in; only state, nonce and the verifier's hash leave the process."""

    state: str
    nonce: str
    verifier: str
    browser_sha256: bytes
    address: str
    at_ns: int


class PendingLogins:
    """Pending log-ins in memory, bounded in number and age; called from any thread."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._attempts: OrderedDict[str, PendingLogin] = OrderedDict()

    def begin(self, address: str) -> tuple[PendingLogin, str]:
        """Create a pending log-in; return it with the secret for the browser's cookie."""
        browser = secrets.token_urlsafe(32)
        attempt = PendingLogin(
            state=secrets.token_urlsafe(32),
            nonce=secrets.token_urlsafe(32),
            verifier=secrets.token_urlsafe(48),
            browser_sha256=_sha256(browser),
            address=address,
            at_ns=self._clock.now_ns(),
        )
        with self._lock:
            self._make_room(address)
            self._attempts[attempt.state] = attempt
        return attempt, browser

    def take(self, state: str, browser: str | None) -> PendingLogin:
        """Remove and return a pending log-in; it is removed even if the browser does not match.

        Raises
        ------
        OidcRefusedError
            No such log-in is pending (any more), or another browser began it.
        """
        with self._lock:
            attempt = self._attempts.pop(state, None)
        if attempt is None or self._has_expired(attempt):
            raise OidcRefusedError(OidcReason.STATE, "this log-in was not begun here, took too long, or is used up")
        if browser is None or not hmac.compare_digest(_sha256(browser), attempt.browser_sha256):
            raise OidcRefusedError(OidcReason.STATE, "another browser began this log-in")
        return attempt

    def _make_room(self, address: str) -> None:
        while self._attempts and self._has_expired(next(iter(self._attempts.values()))):
            self._attempts.popitem(last=False)
        own = [state for state, attempt in self._attempts.items() if attempt.address == address]
        if len(own) >= MAX_PER_ADDRESS:
            del self._attempts[own[0]]
        elif len(self._attempts) >= MAX_PENDING:
            self._attempts.popitem(last=False)

    def _has_expired(self, attempt: PendingLogin) -> bool:
        return self._clock.now_ns() - attempt.at_ns > LIFE_S * NS_PER_S


class FailureLimiter:
    """Limits the refused codes per address, since each costs a call to the provider with our client id."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._failures: OrderedDict[str, deque[int]] = OrderedDict()

    def record(self, address: str) -> None:
        """Count a code that the provider refused."""
        with self._lock:
            own = self._failures.setdefault(address, deque(maxlen=MAX_FAILURES))
            own.append(self._clock.now_ns())
            self._failures.move_to_end(address)
            if len(self._failures) > MAX_PENDING:
                self._failures.popitem(last=False)

    def is_limited(self, address: str) -> bool:
        """Whether this address has reached the limit within `LIFE_S`."""
        with self._lock:
            own = self._failures.get(address)
            return own is not None and len(own) == MAX_FAILURES and self._clock.now_ns() - own[0] <= LIFE_S * NS_PER_S


def _sha256(text: str) -> bytes:
    return hashlib.sha256(text.encode("utf-8", "replace")).digest()
