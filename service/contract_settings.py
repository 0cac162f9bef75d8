"""What the site decides about the contract with other software."""

from pydantic import Field
from pydantic_settings import BaseSettings


class ContractSettings(BaseSettings):
    """For how long an Idempotency-Key is known."""

    idempotency_days: float = Field(
        default=7.0,
        ge=1.0,
        le=365.0,
        description="An Idempotency-Key is known for so long; sent again later it is a new one",
    )
