"""Schemas of camera calibrations."""

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
