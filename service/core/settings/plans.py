"""Settings of RT Plans: their largest size, and the patient's reference."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator
from pydantic_settings import BaseSettings

SHORTEST_KEY_BYTES = 32
LONGEST_KEY_BYTES = 4_096


class PlanSettings(BaseSettings):
    """Settings of RT Plans (docs/4-integrate/plans.md)."""

    max_plan_bytes: int = Field(
        default=8_388_608,
        ge=65_536,
        le=67_108_864,
        description="Largest RT Plan; other request bodies have a lower limit",
    )
    plan_patient: Literal["id", "hash"] = Field(
        default="id", description="Patient reference of a plan: the Patient ID, or a keyed hash of it"
    )
    plan_patient_key: Path | None = Field(
        default=None, description="File of 32 bytes or more, the key of the hash; only with hash"
    )

    @model_validator(mode="after")
    def _has_key(self) -> Self:
        if (self.plan_patient == "hash") != (self.plan_patient_key is not None):
            msg = "TIDEGATE_PLAN_PATIENT_KEY must be a file with plans.plan_patient=hash, and left out with id"
            raise ValueError(msg)
        _ = self.plan_patient_secret
        return self

    @property
    def plan_patient_secret(self) -> bytes | None:
        """Key of the hash of Patient IDs, read from its file at each call; None without hash."""
        if self.plan_patient_key is None:
            return None
        try:
            with self.plan_patient_key.open("rb") as file:
                secret = file.read(LONGEST_KEY_BYTES + 1).strip()
        except OSError as error:
            msg = f"TIDEGATE_PLAN_PATIENT_KEY cannot be read: {error.strerror}"
            raise ValueError(msg) from error
        if not SHORTEST_KEY_BYTES <= len(secret) <= LONGEST_KEY_BYTES:
            msg = f"TIDEGATE_PLAN_PATIENT_KEY must hold {SHORTEST_KEY_BYTES} to {LONGEST_KEY_BYTES} bytes"
            raise ValueError(msg)
        return secret
