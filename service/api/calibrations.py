"""Camera calibrations: upload, list, read."""

from fastapi import APIRouter, Response

from service import deps, schemas
from service.api import problems

router = APIRouter(prefix="/calibrations", tags=["calibrations"])
DOCUMENT = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": {
                    "type": "object",
                    "description": "A `tidegate.calibration/1` document; the engine's own parser checks it",
                    "required": ["schema", "camera", "depth", "color", "depth_to_color"],
                }
            }
        },
    }
}


@router.post(
    "", status_code=201, name="calibration.upload", responses=problems(409, 413, 415, 422, 503), openapi_extra=DOCUMENT
)
def upload_calibration(
    body: deps.Body,
    operator: deps.OperatorName,
    services: deps.Offered,
    response: Response,
    idempotency_key: deps.IdempotencyKey = None,
) -> schemas.Calibration:
    """Check and keep a calibration; the same content again answers with the same one, and 200."""
    kept = services.calibrations.upload(body, operator, idempotency_key)
    if kept.is_replay:
        response.status_code = 200
    return kept.answer


@router.get("", responses=problems(422, 503))
def list_calibrations(
    services: deps.Offered, cursor: deps.Cursor = None, limit: deps.Limit = 50
) -> schemas.CalibrationPage:
    """List calibrations, newest first."""
    return services.calibrations.page(cursor, limit)


@router.get("/{calibration_id}", responses=problems(404, 422, 503))
def read_calibration(calibration_id: deps.CalibrationId, services: deps.Offered) -> schemas.CalibrationDetail:
    """Read a calibration with its document."""
    return services.calibrations.detail(calibration_id)
