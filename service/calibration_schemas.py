"""What is told of camera calibrations."""

from typing import Literal

from pydantic import AwareDatetime, Field

from service.schema_base import Answer, Identifier

CalibrationFormat = Literal["tidegate.calibration/1", "opencv-filestorage", "ros-camera-info"]


class Calibration(Answer):
    """A stored camera calibration; the same content has the same id."""

    id: Identifier
    sha256: str
    camera: str
    uploaded_by: str
    created_at: AwareDatetime


class UploadedCalibration(Calibration):
    """A calibration as just uploaded: which format it came in, and what was assumed on the way."""

    format: CalibrationFormat = "tidegate.calibration/1"
    notes: list[str] = Field(default=[], description="To be read by the person who uploads")


class CalibrationDetail(Calibration):
    """A calibration with its canonical document."""

    document: dict[str, object]


class CalibrationPage(Answer):
    """Newest first."""

    items: list[Calibration]
    next_cursor: str | None
