"""Settings of the HTTP contract."""

from pydantic import Field
from pydantic_settings import BaseSettings


class ContractSettings(BaseSettings):
    """Lifetime of Idempotency-Keys."""

    idempotency_days: float = Field(
        default=7.0,
        ge=1.0,
        le=365.0,
        description="Lifetime of an Idempotency-Key; after it the key is treated as new",
    )
