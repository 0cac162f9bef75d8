"""Camera calibrations: upload, list, read."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from engine.calibration_formats.convert import IMPORT_SCHEMA
from engine.errors import CalibrationError
from service import deps
from service.api import problems
from service.calibration_schemas import CalibrationDetail, CalibrationPage, UploadedCalibration
from service.conditional import etag_of
from service.errors import BoundError, NotFoundError, OperatorMismatchError
from service.schema_base import Name

router = APIRouter(prefix="/calibrations", tags=["calibrations"])
UPLOAD: dict[int | str, dict[str, Any]] = {
    200: {"model": UploadedCalibration, "description": "It was there already, with the same content"},
    **problems(BoundError, CalibrationError, OperatorMismatchError),
}
TEXT = {"schema": {"type": "string"}}
DOCUMENT = {
    "requestBody": {
        "required": True,
        "description": (
            "A `tidegate.calibration/1` document; or an OpenCV FileStorage (JSON, YAML or XML); or two ROS "
            "`camera_info` documents in one YAML stream; or a `tidegate.calibration-import/1` document, which holds "
            "the texts of several files and what they leave open. Recognised by what it says; what is ambiguous is "
            "refused by name."
        ),
        "content": {
            "application/json": {
                "schema": {
                    "anyOf": [
                        {
                            "type": "object",
                            "title": "tidegate.calibration/1",
                            "description": "The engine's own parser checks it",
                            "required": ["schema", "camera", "depth", "color", "depth_to_color"],
                        },
                        {
                            "type": "object",
                            "title": "tidegate.calibration-import/1",
                            "required": ["schema", "files"],
                            "additionalProperties": False,
                            "properties": {
                                "schema": {"const": IMPORT_SCHEMA},
                                "files": {"type": "array", "items": {"type": "string"}, "minItems": 1, "maxItems": 4},
                                "camera": {"type": "string", "minLength": 1, "maxLength": 80},
                                "first_camera": {"enum": ["depth", "color"]},
                                "translation_unit": {"enum": ["mm", "m"]},
                                "image_size_px": {"type": "array", "items": {"type": "integer"}, "maxItems": 2},
                                "baseline_mm": {"type": "number", "minimum": -200, "maximum": 200},
                                "depth_to_color": {"type": "object", "required": ["rotation", "translation_mm"]},
                            },
                        },
                        {"type": "object", "title": "OpenCV FileStorage"},
                    ]
                }
            },
            "application/yaml": TEXT,
            "application/xml": TEXT,
        },
    }
}


@router.post("", status_code=201, name="calibration.upload", responses=UPLOAD, openapi_extra=DOCUMENT)
def upload_calibration(
    body: deps.Body,
    caller: deps.Caller,
    services: deps.Offered,
    response: Response,
    operator: deps.OperatorName = "",
    idempotency_key: deps.IdempotencyKey = None,
) -> UploadedCalibration:
    """Check and keep a calibration; the same content again answers with the same one, and 200."""
    kept = services.calibrations.upload(body, caller.acts_as(operator), idempotency_key)
    if kept.is_replay:
        response.status_code = 200
    return kept.answer


@router.get("")
def list_calibrations(
    services: deps.Offered,
    pages: deps.Pages50,
    camera: Annotated[Name | None, Query(description="Only those of this camera")] = None,
) -> CalibrationPage:
    """List calibrations, newest first."""
    return pages.told(services.calibrations.page(pages.cursor, pages.limit, camera))


@router.get("/{calibration_id}", responses=problems(NotFoundError))
def read_calibration(
    calibration_id: deps.CalibrationId, services: deps.Offered, fresh: deps.IfNoneMatch
) -> CalibrationDetail:
    """Read a calibration with its document; it never changes."""
    detail = services.calibrations.detail(calibration_id)
    return fresh.told(detail, etag_of("calibration", detail.id, detail.sha256))
