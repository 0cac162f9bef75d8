"""What is kept of a pairing code and of a paired screen; in memory only, secrets as hashes."""

from dataclasses import dataclass
from datetime import datetime


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
