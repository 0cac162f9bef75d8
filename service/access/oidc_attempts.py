"""Log-ins that have set out to the provider and are not back yet: each for five minutes, once, for one browser."""

import hashlib
import hmac
import secrets
import threading
from collections import OrderedDict, deque
from dataclasses import dataclass

from engine.clock import NS_PER_S, Clock
from service.access.oidc_errors import OidcReason, OidcRefusedError

LIFE_S = 300.0
MOST = 4_096
MOST_AN_ADDRESS = 64
"""From one address; a flood from there drops its own oldest, nobody else's."""
MOST_FAILURES = 20
"""Codes that the provider does not take, from one address within an attempt's life."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Attempt:
    """What has to come back, and what is needed then; never leaves this process but for the nonce and the state."""

    state: str
    nonce: str
    verifier: str
    browser_sha256: bytes
    address: str
    at_ns: int


class AttemptShelf:
    """Keeps attempts until they come back, are too old, or too many."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._attempts: OrderedDict[str, Attempt] = OrderedDict()

    def begin(self, address: str) -> tuple[Attempt, str]:
        """Make an attempt; return it with the secret that the browser keeps in a cookie."""
        browser = secrets.token_urlsafe(32)
        attempt = Attempt(
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

    def take(self, state: str, browser: str | None) -> Attempt:
        """Take an attempt off the shelf, for good, whether or not the browser is the one that began it.

        Raises
        ------
        OidcRefusedError
            There is no such attempt (any more), or another browser began it.
        """
        with self._lock:
            attempt = self._attempts.pop(state, None)
        if attempt is None or self._is_old(attempt):
            raise OidcRefusedError(OidcReason.STATE, "this log-in was not begun here, took too long, or is used up")
        if browser is None or not hmac.compare_digest(_sha256(browser), attempt.browser_sha256):
            raise OidcRefusedError(OidcReason.STATE, "another browser began this log-in")
        return attempt

    def _make_room(self, address: str) -> None:
        while self._attempts and self._is_old(next(iter(self._attempts.values()))):
            self._attempts.popitem(last=False)
        own = [state for state, attempt in self._attempts.items() if attempt.address == address]
        if len(own) >= MOST_AN_ADDRESS:
            del self._attempts[own[0]]
        elif len(self._attempts) >= MOST:
            self._attempts.popitem(last=False)

    def _is_old(self, attempt: Attempt) -> bool:
        return self._clock.now_ns() - attempt.at_ns > LIFE_S * NS_PER_S


class FailureBrake:
    """Stops an address that brings back one wrong code after the other: each is a call to the provider, in our name."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._lock = threading.Lock()
        self._failures: OrderedDict[str, deque[int]] = OrderedDict()

    def note(self, address: str) -> None:
        """Count a code that the provider did not take."""
        with self._lock:
            own = self._failures.setdefault(address, deque(maxlen=MOST_FAILURES))
            own.append(self._clock.now_ns())
            self._failures.move_to_end(address)
            if len(self._failures) > MOST:
                self._failures.popitem(last=False)

    def is_on(self, address: str) -> bool:
        """Whether this address has to wait."""
        with self._lock:
            own = self._failures.get(address)
            return own is not None and len(own) == MOST_FAILURES and self._clock.now_ns() - own[0] <= LIFE_S * NS_PER_S


def _sha256(text: str) -> bytes:
    return hashlib.sha256(text.encode("utf-8", "replace")).digest()
