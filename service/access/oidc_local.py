"""Passwords of Tidegate's own while people log in at the provider: for the day it is down, and never quietly."""

from dataclasses import dataclass
from typing import Protocol

from service.errors import BoundError, LocalLoginRefusedError
from service.oidc_settings import OidcSettings

SHORTEST_REASON = 8
LONGEST_REASON = 500


class Account(Protocol):
    """The part of a person that decides."""

    @property
    def is_break_glass(self) -> bool:
        """Whether the account is for when the provider is down."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalLogins:
    """Decides, once a password was right, whether it may be used."""

    settings: OidcSettings

    def check(self, account: Account, reason: str | None) -> bool:
        """Return whether this is a break-glass use, to be told loudly.

        Raises
        ------
        LocalLoginRefusedError
            The account is to log in at the provider.
        BoundError
            A break-glass account says not why.
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
