"""What a site sets about RT Plans: how large one may be, and how its patient is called here."""

from pathlib import Path
from typing import Literal, Self

from pydantic import Field, model_validator
from pydantic_settings import BaseSettings

SHORTEST_KEY_BYTES = 32
LONGEST_KEY_BYTES = 4_096


class PlanSettings(BaseSettings):
    """RT Plans; see docs/4-integrate/plans.md."""

    max_plan_bytes: int = Field(
        default=8_388_608,
        ge=65_536,
        le=67_108_864,
        description="No RT Plan's file is larger; all other bodies are less",
    )
    plan_patient: Literal["id", "hash"] = Field(
        default="id", description="How a plan's patient is called: by its Patient ID, or by a keyed hash of it"
    )
    plan_patient_key: Path | None = Field(
        default=None, description="A file of 32 bytes or more that the hash is keyed with; with hash alone"
    )

    @model_validator(mode="after")
    def _has_a_key_to_hash_with(self) -> Self:
        if (self.plan_patient == "hash") != (self.plan_patient_key is not None):
            msg = "TIDEGATE_PLAN_PATIENT_KEY must be a file with TIDEGATE_PLAN_PATIENT=hash, and left out with id"
            raise ValueError(msg)
        _ = self.plan_patient_secret
        return self

    @property
    def plan_patient_secret(self) -> bytes | None:
        """What Patient IDs are hashed with; None where they are kept. Read anew each time, and kept nowhere."""
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
