"""Local passwords while users log in at the provider: break-glass accounts for its outage, always audited."""

from dataclasses import dataclass
from typing import Protocol

from service.core.errors import BoundError, LocalLoginRefusedError
from service.core.settings.oidc import OidcSettings

SHORTEST_REASON = 8
LONGEST_REASON = 500


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
