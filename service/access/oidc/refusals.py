"""Errors of log-ins and tokens of the OpenID Connect provider; the reasons are stable codes for audit and metrics."""

from enum import StrEnum
from typing import ClassVar

from service.core.errors import ServiceError

TIMEOUT_S = 5.0
"""Longest wait for the provider."""


class OidcReason(StrEnum):
    """Why a token, a response or a log-in of the provider is refused."""

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
    """A token or response failed validation; the message never contains its content."""

    code: ClassVar[str] = "oidc_refused"

    def __init__(self, reason: OidcReason, detail: str = "") -> None:
        self.reason = reason
        super().__init__(f"{reason.value}: {detail}" if detail else reason.value)


class OidcUnavailableError(ServiceError):
    """The provider cannot be reached, or its response is not valid OpenID Connect."""

    code: ClassVar[str] = "oidc_unavailable"
