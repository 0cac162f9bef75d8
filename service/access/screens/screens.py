"""Pairs patient screens by one-time codes, and authenticates them.

Codes and screens are in memory: the end of the service ends every pairing. A screen's credential is a cookie of its
own, which the guard reads on routes of the coaching stream alone (:mod:`service.web.middleware.guard`).

What is kept of a pairing code and of a paired screen; in memory only, secrets as hashes.
"""

import hmac
import secrets
import threading
import uuid
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from operator import attrgetter

from service.access.accounts.records import Attempts
from service.access.accounts.store import AccessStore
from service.access.login import lockout
from service.access.login.lockout import RefusedLogins
from service.access.login.logins import TOKEN_BYTES, hashed
from service.core.errors import LockedOutError, NotFoundError, PairingRefusedError
from service.storage.audit import Event

CODE, PAIR, END = "screen.code", "screen.pair", "screen.end"
CODE_DIGITS = 6
CODE_LIFE = timedelta(minutes=2)
MAX_WRONG_CODES = 5
"""Wrong codes, from any address, after which the open one is void: the chance of a right guess is 1 in 200 000."""
MAX_SCREENS = 4
MAX_ADDRESSES = 1_000
REFUSED = "pairing codes"


@dataclass(frozen=True, slots=True, kw_only=True)
class PairingCode:
    """A code that waits for a screen; ``attempts_left`` wrong ones are accepted before it is void."""

    code_sha256: str
    salt: str
    opened_by: str
    expires_at: datetime
    attempts_left: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Screen:
    """A paired screen, which alone has the token. ``number`` counts the screens since the start of the service."""

    id: str
    number: int
    token_sha256: str
    paired_by: str
    address: str
    paired_at: datetime
    expires_at: datetime


@dataclass(frozen=True, slots=True, kw_only=True)
class OpenedCode:
    """A newly opened code, which is displayed and not stored; ``repr`` omits it."""

    code: str
    expires_at: datetime

    def __repr__(self) -> str:
        return f"OpenedCode(expires_at={self.expires_at!r})"


@dataclass(frozen=True, slots=True, kw_only=True)
class PairedScreen:
    """A newly paired screen and its token, which is sent to the browser and not stored; ``repr`` omits it."""

    token: str
    screen: Screen

    def __repr__(self) -> str:
        return f"PairedScreen(screen={self.screen.number!r})"


class ScreenService:
    """Opens codes, pairs and ends screens; each change is audited first.

    Parameters
    ----------
    lasts
        Life of a pairing, whether or not it is used.
    idle
        A screen that has not watched for longer than this is not paired any more.
    """

    def __init__(self, store: AccessStore, refused_logins: RefusedLogins, *, lasts: timedelta, idle: timedelta) -> None:
        self._store, self._refused = store, refused_logins
        self._lasts, self._idle = lasts, idle
        self._changing = threading.Lock()
        self._code: PairingCode | None = None
        self._screens: dict[str, Screen] = {}
        self._seen: dict[str, datetime] = {}
        self._attempts: dict[str, Attempts] = {}
        self._count = 0

    def open_code(self, *, by: str) -> OpenedCode:
        """Open a code for one screen; it replaces a code that is still open."""
        code = f"{secrets.randbelow(10**CODE_DIGITS):0{CODE_DIGITS}}"
        salt = secrets.token_hex(16)
        expires_at = self._store.now() + CODE_LIFE
        with self._changing:
            self._store.write(event=Event(actor=by, action=CODE, detail={"expires_at": expires_at.isoformat()}))
            self._code = PairingCode(
                code_sha256=hashed(salt + code),
                salt=salt,
                opened_by=by,
                expires_at=expires_at,
                attempts_left=MAX_WRONG_CODES,
            )
        return OpenedCode(code=code, expires_at=expires_at)

    def pair(self, code: str, address: str) -> PairedScreen:
        """Pair the sender of the open code; the oldest screen is ended where there are too many.

        Raises
        ------
        LockedOutError
            The address sent too many wrong codes, and has to wait.
        PairingRefusedError
            No code is open, or it is another one; the answer is the same.
        """
        with self._changing:
            self._refuse_locked(address)
            opened = self._code
            if opened is None or not self._is_right(opened, code):
                self._record_failure(opened, address)
                raise PairingRefusedError
            self._code = None
            return self._pair(opened, address)

    def end(self, screen_id: str, *, by: str) -> None:
        """End a pairing; its stream closes within seconds. Raise NotFoundError if there is none."""
        with self._changing:
            screen = next((one for one in self._screens.values() if one.id == screen_id), None)
            if screen is None:
                msg = "there is no such screen"
                raise NotFoundError(msg, field="screen_id", value=screen_id)
            self._store.write(event=Event(actor=by, action=END, detail={"screen": screen.number}))
            self._forget(screen)

    def all(self) -> list[tuple[Screen, datetime]]:
        """List the paired screens with the time at which each watched last, the oldest first."""
        found = [one for one in list(self._screens.values()) if self._is_open(one)]
        return [(one, self._seen[one.token_sha256]) for one in sorted(found, key=attrgetter("number"))]

    def code_expiry(self) -> datetime | None:
        """When the open code expires; None where no code is open."""
        opened = self._code
        return None if opened is None or self._store.now() >= opened.expires_at else opened.expires_at

    def find(self, token_sha256: str) -> Screen | None:
        """Return the paired screen of a token's hash, None if it is not paired any more; counts as use."""
        screen = self._screens.get(token_sha256)
        if screen is None or not self._is_open(screen):
            return None
        self._seen[token_sha256] = self._store.now()
        return screen

    def _is_open(self, screen: Screen) -> bool:
        now = self._store.now()
        seen = self._seen.get(screen.token_sha256)
        return seen is not None and now < screen.expires_at and now - seen <= self._idle

    def _is_right(self, opened: PairingCode, code: str) -> bool:
        is_same = hmac.compare_digest(opened.code_sha256, hashed(opened.salt + code))
        return is_same and self._store.now() < opened.expires_at

    def _pair(self, opened: PairingCode, address: str) -> PairedScreen:
        now, token = self._store.now(), secrets.token_urlsafe(TOKEN_BYTES)
        screen = Screen(
            id=uuid.uuid4().hex,
            number=self._count + 1,
            token_sha256=hashed(token),
            paired_by=opened.opened_by,
            address=address,
            paired_at=now,
            expires_at=now + self._lasts,
        )
        surplus = [one for one in self._screens.values() if not self._is_open(one)]
        kept = sorted((one for one in self._screens.values() if one not in surplus), key=attrgetter("number"))
        surplus += kept[: max(0, len(kept) - MAX_SCREENS + 1)]
        detail = {"screen": screen.number, "address": address, "ended": [one.number for one in surplus]}
        self._store.write(event=Event(actor=opened.opened_by, action=PAIR, detail=detail))
        for one in surplus:
            self._forget(one)
        self._count = screen.number
        self._seen[screen.token_sha256] = now
        self._screens[screen.token_sha256] = screen
        return PairedScreen(token=token, screen=screen)

    def _forget(self, screen: Screen) -> None:
        self._screens.pop(screen.token_sha256, None)
        self._seen.pop(screen.token_sha256, None)

    def _refuse_locked(self, address: str) -> None:
        left_s = lockout.wait_s(self._attempts.get(lockout.address_subject(address)), self._store.now())
        if left_s > 0:
            self._refused.count(REFUSED, address)
            raise LockedOutError(left_s)

    def _record_failure(self, opened: PairingCode | None, address: str) -> None:
        """Count a wrong code for the address and for the open code, which is void after the last attempt."""
        subject, now = lockout.address_subject(address), self._store.now()
        self._attempts[subject] = lockout.failed_again(self._attempts.pop(subject, None), subject, now)
        if len(self._attempts) > MAX_ADDRESSES:
            self._attempts.pop(next(iter(self._attempts)))  # the one that failed longest ago
        self._refused.count(REFUSED, address)
        if opened is None:
            return
        left = replace(opened, attempts_left=opened.attempts_left - 1)
        self._code = left if left.attempts_left > 0 and now < left.expires_at else None
        if left.attempts_left == 0:
            detail = {"address": address, "reason": f"{MAX_WRONG_CODES} wrong codes: the code is void"}
            self._refused.record(Event(actor=opened.opened_by, action=PAIR, outcome="refused", detail=detail))
