"""Routes of camera calibrations: upload, list, read."""

from typing import Annotated, Any

from fastapi import APIRouter, Query, Response

from engine.calibration.formats import IMPORT_SCHEMA
from service.access.request.identity import NOT_GIVEN
from service.core.conditional import etag_of
from service.core.schemas.base import Name
from service.core.schemas.records import CalibrationDetail, CalibrationPage, UploadedCalibration
from service.web import dependencies

router = APIRouter(prefix="/calibrations", tags=["calibrations"])
UPLOAD: dict[int | str, dict[str, Any]] = {
    200: {"model": UploadedCalibration, "description": "The same content is stored already"},
}
TEXT = {"schema": {"type": "string"}}
DOCUMENT = {
    "requestBody": {
        "required": True,
        "description": (
            "A `tidegate.calibration/1` document; or an OpenCV FileStorage (JSON, YAML or XML); or two ROS "
            "`camera_info` documents in one YAML stream; or a `tidegate.calibration-import/1` document, which contains "
            "several files and the parameters that they lack. The format is detected from the content; ambiguous files "
            "are refused."
        ),
        "content": {
            "application/json": {
                "schema": {
                    "anyOf": [
                        {
                            "type": "object",
                            "title": "tidegate.calibration/1",
                            "description": "Validated by the engine's parser",
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
    body: dependencies.Body,
    caller: dependencies.Caller,
    services: dependencies.AppServices,
    response: Response,
    operator: dependencies.OperatorName = None,
    idempotency_key: dependencies.IdempotencyKey = None,
) -> UploadedCalibration:
    """Validate and store a calibration; the same content again returns the stored one with 200."""
    stored = services.calibrations.upload(body, caller.checked_actor(operator or NOT_GIVEN), idempotency_key)
    if stored.is_replay:
        response.status_code = 200
    return stored.answer


@router.get("")
def list_calibrations(
    services: dependencies.AppServices,
    pages: dependencies.Pages50,
    camera: Annotated[Name | None, Query(description="Only calibrations of this camera")] = None,
) -> CalibrationPage:
    """List calibrations, newest first."""
    return pages.answer(services.calibrations.page(pages.cursor, pages.limit, camera))


@router.get("/{calibration_id}")
def read_calibration(
    calibration_id: dependencies.CalibrationId, services: dependencies.AppServices, fresh: dependencies.IfNoneMatch
) -> CalibrationDetail:
    """Read a calibration with its document; calibrations never change."""
    detail = services.calibrations.detail(calibration_id)
    return fresh.answer(detail, etag_of("calibration", detail.id, detail.sha256))
