"""What routers are given: the ports, found on the application, and the parameters they share."""

from dataclasses import dataclass
from typing import Annotated, cast

from fastapi import Depends, Header, Path, Query, Request
from starlette.requests import HTTPConnection

from service import ports
from service.errors import MediaTypeError
from service.qa.ports import QaBookPort, QaDeskPort
from service.schema_base import Identifier, Name


@dataclass(frozen=True, slots=True, kw_only=True)
class Services:
    """Everything the application offers."""

    sessions: ports.SessionsPort
    runner: ports.RunnerPort
    calibrations: ports.CalibrationsPort
    models: ports.ModelsPort
    audit: ports.AuditPort
    health: ports.HealthPort
    interlocks: ports.InterlocksPort
    metrics: ports.MetricsPort
    engine: ports.EnginePort
    qa_desk: QaDeskPort
    qa_book: QaBookPort


def services(connection: HTTPConnection) -> Services:
    """Find the services on the application; they are made in the lifespan."""
    return cast("Services", connection.app.state.services)


async def json_body(request: Request) -> bytes:
    """Read the raw body, as far as the body limit lets it."""
    return await request.body()


CALIBRATION_MEDIA = ("application/json", "application/yaml", "application/xml")
"""What a calibration may be uploaded as; no form of a foreign page can post any of them."""
MEDIA_OF = {"calibration.upload": CALIBRATION_MEDIA}


def require_json(request: Request) -> None:
    """Refuse a body that is not JSON by its Content-Type: a form of a foreign page could post it otherwise."""
    if request.method not in {"POST", "PUT"}:
        return
    allowed = MEDIA_OF.get(getattr(request.scope.get("route"), "name", ""), ("application/json",))
    media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media_type not in allowed:
        bound = " or ".join(allowed)
        msg = f"Content-Type must be {bound}"
        raise MediaTypeError(msg, field="Content-Type", value=media_type, bound=bound)


Offered = Annotated[Services, Depends(services)]
Body = Annotated[bytes, Depends(json_body)]
SessionId = Annotated[Identifier, Path(description="The session's id")]
CalibrationId = Annotated[Identifier, Path(description="The calibration's id")]
ModelId = Annotated[Identifier, Path(description="The model's id")]
Cursor = Annotated[str | None, Query(max_length=80, description="`next_cursor` of the page before")]
Limit = Annotated[int, Query(ge=1, le=500, description="Most items on the page")]
OperatorName = Annotated[Name, Query(description="Who uploads", examples=["A. Physicist"])]
IdempotencyKey = Annotated[
    str | None,
    Header(
        min_length=1,
        max_length=255,
        pattern=r"^[\x21-\x7e]+$",
        description="The same key with the same body gives the same answer, once and for all",
    ),
]
