"""Why nobody got in by the outside provider; reasons are stable words, for the audit, the page and the metrics."""

from enum import StrEnum
from typing import ClassVar

from service.errors import ServiceError


class OidcReason(StrEnum):
    """Why a token, an answer or a log-in of the outside provider is refused."""

    MALFORMED = "malformed"
    ALGORITHM = "algorithm"
    UNKNOWN_KEY = "unknown_key"
    SIGNATURE = "signature"
    TYPE = "type"
    ISSUER = "issuer"
    AUDIENCE = "audience"
    EXPIRED = "expired"
    NOT_YET_VALID = "not_yet_valid"
    TOO_LONG_LIVED = "too_long_lived"
    NONCE = "nonce"
    CLAIMS = "claims"
    SCOPE = "scope"
    STATE = "state"
    CODE = "code"
    PROVIDER_REFUSED = "provider_refused"
    NO_ROLE = "no_role"


class OidcRefusedError(ServiceError):
    """A token or an answer that is not believed; the words never repeat what it says."""

    code: ClassVar[str] = "oidc_refused"

    def __init__(self, reason: OidcReason, detail: str = "") -> None:
        self.reason = reason
        super().__init__(f"{reason.value}: {detail}" if detail else reason.value)


class OidcUnavailableError(ServiceError):
    """The outside provider cannot be asked, or answers what no provider would."""

    code: ClassVar[str] = "oidc_unavailable"
