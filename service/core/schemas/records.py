"""Schemas of what is stored beside sessions: camera calibrations, motion models, recordings."""

from typing import Literal

from pydantic import AwareDatetime, Field

from service.core.schemas.base import Answer, Identifier

CalibrationFormat = Literal["tidegate.calibration/1", "opencv-filestorage", "ros-camera-info"]


class Calibration(Answer):
    """A stored camera calibration; the same content has the same id."""

    id: Identifier
    sha256: str
    camera: str
    uploaded_by: str
    created_at: AwareDatetime


class UploadedCalibration(Calibration):
    """An uploaded calibration with its source format and the assumptions of the conversion."""

    format: CalibrationFormat = "tidegate.calibration/1"
    notes: list[str] = Field(
        default=[], description="Assumptions and warnings of the conversion, for the person who uploads"
    )


class CalibrationDetail(Calibration):
    """A calibration with its document in the canonical format."""

    document: dict[str, object]


class CalibrationPage(Answer):
    """Calibrations, newest first; `next_cursor` is null on the last page."""

    items: list[Calibration]
    next_cursor: str | None


class ModelQuality(Answer):
    """Quality of a model's training frames."""

    amplitude_mm: float = Field(description="Breathing excursion, 5th to 95th percentile")
    noise_mm: float
    explained_share: float = Field(description="Share of the variance that the model's components explain")
    shift_mm: float = Field(
        description="Displacement of the patient between the first and the last third of the training"
    )
    tilt_deg: float
    outlier_share: float = Field(
        description="Share of frames excluded from the model, for example with a cough or a hand"
    )
    residual_mm: float


class Model(Answer):
    """A motion model of a session."""

    id: Identifier
    session_id: Identifier
    number: int = Field(description="Number of the model in the session; 1 is the first")
    sha256: str
    components: int
    is_active: bool
    created_at: AwareDatetime
    patient_reference: str
    calibration_id: Identifier
    training_frames: int | None = None
    cycles: int | None = None
    source: str | None = Field(default=None, description="Recording or camera of the training frames")
    software: str | None = None
    quality: ModelQuality | None = None
    settings: dict[str, float] = Field(default={}, description="Training settings")


class ModelPage(Answer):
    """Models, newest first; `next_cursor` is null on the last page."""

    items: list[Model]
    next_cursor: str | None


class Spectrum(Answer):
    """Share of the motion that each component explains, largest first (article, figure 5)."""

    model_id: Identifier
    share: list[float] = Field(description="Shares of the variance, 0 to 1")


class ModelSimilarity(Answer):
    """How alike two models of a patient are, on the grid that the markers span."""

    model_id: Identifier
    other_id: Identifier
    explained_share: float = Field(
        description="Share of the model's motion that the other's components can express; 1: the same breathing"
    )
    first_angle_deg: float = Field(description="Angle of the model's first component to the other's components")
    shift_mm: float | None = Field(description="Mean of model less other of the mean depths; null if none is common")
    shape_mm: float | None = Field(description="Standard deviation of that difference: the shape that has changed")


class QualityMaps(Answer):
    """What a model does with the frames it was trained from, on every fourth row and column of the region.

    All three are null for models of earlier versions. Row 0 is superior, column 0 the patient's right.
    """

    model_id: Identifier
    measured_mm: list[list[float | None]] | None = Field(
        description="The deepest breath as the camera measured it: height above the mean surface; null where it "
        "measured nothing",
    )
    reconstructed_mm: list[list[float]] | None = Field(description="The same frame as the model reconstructs it")
    residual_mm: list[list[float | None]] | None = Field(
        description="Root mean square of measured minus reconstructed over up to 60 frames, with the camera's noise"
    )


class Recording(Answer):
    """A recording in one of the site's folders, described by its first records; no frame is read."""

    path: str = Field(description="As in a session's `source.path`", examples=["demo/recording.oni"])
    bytes: int | None = Field(description="Size of the file")
    modified_at: AwareDatetime | None
    seconds: float | None = Field(description="Length as the file states it; null if it does not", examples=[40.0])
    width_px: int | None = Field(description="Of the depth pictures")
    height_px: int | None
    fps: int | None = Field(description="Nominal rate of the depth pictures [1/s]", examples=[30])
    has_color: bool | None = Field(description="Markers are found in colour: without it no session can be measured")
    mirrored: str | None = Field(
        description="Streams whose pictures are stored mirrored, and turned round when played; null for none. Its "
        "calibration has to be of pictures that are not mirrored",
        examples=["depth and colour"],
    )
    problem: str | None = Field(
        description="Why it cannot be played; null if its first records are whole, and its first times possible"
    )


class RecordingPage(Answer):
    """Recordings by path; `next_cursor` is null on the last page."""

    items: list[Recording]
    next_cursor: str | None
