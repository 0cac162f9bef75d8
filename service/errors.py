"""Errors of the service, and the one table that turns errors into HTTP (RFC 9457 problems)."""

from collections.abc import Mapping
from typing import ClassVar

from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException

from engine import errors as engine_errors
from engine.errors import TidegateError
from service import schemas

PROBLEM_TYPE = "urn:tidegate:problem:"
MEDIA_TYPE = "application/problem+json"
SHOWN_CHARACTERS = 80
SOURCE_TAGS = {"recording", "device"}
"""What pydantic puts into the path of a source's field: the kind, which is no field."""


class ServiceError(TidegateError):
    """An error of the service; may name a field, its value and the bound it broke."""

    code: ClassVar[str] = "service_error"

    def __init__(
        self, message: str, *, field: str | None = None, value: object = None, bound: str | None = None
    ) -> None:
        self.field = field
        self.value = None if value is None else shown(value)
        self.bound = bound
        super().__init__(message)


class BoundError(ServiceError):
    """A value is out of a bound that only the service knows: a site's limit, an allowed folder, a cursor."""

    code = "invalid_value"


class NotFoundError(ServiceError):
    """There is no such thing."""

    code = "not_found"


class SessionActiveError(ServiceError):
    """Another session is created or running; there is one room, one camera and one beam."""

    code = "session_active"


class SessionStateError(ServiceError):
    """The session is not in a state for that."""

    code = "session_state"


class ServiceStoppingError(ServiceError):
    """The service is on its way out."""

    code = "service_stopping"


class QaActiveError(ServiceError):
    """A QA run has the camera and the beam line."""

    code = "qa_active"


class QaStateError(ServiceError):
    """The QA run is not in a state for that."""

    code = "qa_state"


class QaOverdueError(ServiceError):
    """The site asks for a daily QA before anybody arms, and the newest is too old, failed, or was never done."""

    code = "qa_overdue"


class IdempotencyError(ServiceError):
    """The Idempotency-Key was used before, with another body."""

    code = "idempotency_key_reused"


class StartError(ServiceError):
    """The session's source could not be opened; the session is closed as failed."""

    code = "source_unusable"


class EngineTimeoutError(ServiceError):
    """The engine did not answer in time; the command was withdrawn."""

    code = "engine_timeout"


class PictureMissingError(ServiceError):
    """There is no picture yet."""

    code = "picture_missing"


class MeshMissingError(ServiceError):
    """There is no surface of the newest frame."""

    code = "mesh_missing"


class MediaTypeError(ServiceError):
    """The body is not JSON by its Content-Type."""

    code = "media_type"


STATUS_OF: Mapping[type[Exception], tuple[int, str]] = {
    engine_errors.InvalidValueError: (422, "A value is out of its bound"),
    engine_errors.CalibrationError: (422, "The calibration cannot be true"),
    engine_errors.RecordingError: (422, "The recording cannot be read"),
    engine_errors.ModelError: (409, "The model cannot be used here"),
    engine_errors.CommandRefusedError: (409, "The engine will not do that now"),
    engine_errors.RuntimeMissingError: (503, "The OpenNI2 runtime is missing"),
    engine_errors.SourceLostError: (503, "The camera does not answer"),
    engine_errors.BeamLineError: (503, "The beam line does not answer"),
    BoundError: (422, "A value is out of its bound"),
    NotFoundError: (404, "There is no such thing"),
    SessionActiveError: (409, "Another session is open"),
    SessionStateError: (409, "The session is not in a state for that"),
    ServiceStoppingError: (503, "The service is stopping"),
    QaActiveError: (409, "A QA run is under way"),
    QaStateError: (409, "The QA run is not in a state for that"),
    QaOverdueError: (409, "The daily QA is due"),
    IdempotencyError: (409, "The Idempotency-Key was used for another request"),
    StartError: (422, "The session's source cannot be used"),
    EngineTimeoutError: (503, "The engine did not answer in time"),
    PictureMissingError: (404, "There is no picture yet"),
    MeshMissingError: (404, "There is no surface yet"),
    MediaTypeError: (415, "The body must be JSON"),
    SQLAlchemyError: (503, "The database does not answer"),
}
HTTP_CODES = {
    400: "bad_request",
    404: "not_found",
    405: "method_not_allowed",
    413: "body_too_large",
    415: "media_type",
    421: "host_refused",
}


def shown(value: object) -> str:
    """Show a value in a problem, bounded."""
    text = repr(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."


def problem_of(error: Exception) -> schemas.Problem:
    """Turn any error into a problem; what is not in the table says nothing about its inside."""
    if isinstance(error, RequestValidationError):
        return _validation_problem(error)
    if isinstance(error, HTTPException):
        return _http_problem(error)
    for kind in type(error).__mro__:
        if kind in STATUS_OF:
            return _table_problem(error, *STATUS_OF[kind])
    return _problem(500, "internal_error", "Tidegate failed", "an unexpected error; it is in the service's log")


def problem_response(problem: schemas.Problem, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Answer with a problem."""
    return JSONResponse(
        problem.model_dump(exclude_none=True),
        status_code=problem.status,
        media_type=MEDIA_TYPE,
        headers=None if headers is None else dict(headers),
    )


def _table_problem(error: Exception, status: int, title: str) -> schemas.Problem:
    if isinstance(error, SQLAlchemyError):
        return _problem(status, "storage_unavailable", title, "nothing was changed; try again")
    code = error.code if isinstance(error, TidegateError) else "error"
    found = {name: getattr(error, name, None) for name in ("field", "value", "bound")}
    return _problem(status, code, title, str(error), **found)


def _http_problem(error: HTTPException) -> schemas.Problem:
    code = HTTP_CODES.get(error.status_code, "http_error")
    extra = getattr(error, "problem_fields", {})
    return _problem(error.status_code, code, str(error.detail), str(error.detail), **extra)


def _validation_problem(error: RequestValidationError) -> schemas.Problem:
    first = error.errors()[0]
    context = first.get("ctx", {})
    place, *rest = first["loc"]
    parts = [str(part) for part in rest if place != "body" or part not in SOURCE_TAGS]
    if first["type"] == "json_invalid":
        parts = ["body"]
    if first["type"] == "inconsistent":
        field, value, bound = [*parts, str(context["field"])], str(context["value"]), str(context["bound"])
    else:
        field, value, bound = parts, _offered(first), _bound(str(first["msg"]))
    name = ".".join(field) or "body"
    return _problem(
        422, "invalid_value", "A value is out of its bound", f"{name}: {bound}", field=name, value=value, bound=bound
    )


def _offered(error: Mapping[str, object]) -> str:
    if error["type"] == "missing":
        return "missing"
    return shown(error.get("input"))


def _bound(message: str) -> str:
    text = message.removeprefix("Value error, ").removeprefix("Input should be ").removeprefix("String should ")
    return "not given: the field is unknown" if text == "Extra inputs are not permitted" else text


def _problem(
    status: int,
    code: str,
    title: str,
    detail: str,
    *,
    field: str | None = None,
    value: str | None = None,
    bound: str | None = None,
) -> schemas.Problem:
    return schemas.Problem(
        type=f"{PROBLEM_TYPE}{code}",
        title=title,
        status=status,
        detail=detail,
        code=code,
        field=field,
        value=value,
        bound=bound,
    )
