"""What is told of learned motion models."""

from pydantic import AwareDatetime, Field

from service.schema_base import Answer, Identifier


class ModelQuality(Answer):
    """What a model's training frames were worth."""

    amplitude_mm: float = Field(description="Breathing excursion, 5th to 95th percentile")
    noise_mm: float
    explained_share: float = Field(description="Share of the variance that the kept components explain")
    shift_mm: float = Field(description="How far the patient moved between the first and the last third")
    tilt_deg: float
    outlier_share: float = Field(description="Share of frames with a cough or a hand, left out of the model")
    residual_mm: float


class Model(Answer):
    """A learned motion model of a session."""

    id: Identifier
    session_id: Identifier
    number: int = Field(description="1 for the session's first model")
    sha256: str
    components: int
    is_active: bool
    created_at: AwareDatetime
    patient_reference: str
    calibration_id: Identifier
    training_frames: int | None = None
    cycles: int | None = None
    source: str | None = Field(default=None, description="The recording or camera it was learned from")
    software: str | None = None
    quality: ModelQuality | None = None
    settings: dict[str, float] = Field(default={}, description="How it was learned")


class ModelPage(Answer):
    """Newest first."""

    items: list[Model]
    next_cursor: str | None


class Spectrum(Answer):
    """How much of the motion each component explains, largest first (article, figure 5)."""

    model_id: Identifier
    share: list[float] = Field(description="Share of the variance, each from 0 to 1")
