"""What becomes of errors in HTTP: the one table of their status and title, and problems (RFC 9457) of any of them."""

from collections.abc import Mapping
from typing import Any

from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException

from engine import errors as engine_errors
from engine.errors import TidegateError
from engine.transition_journal import JournalError
from service import errors
from service.errors import SHOWN_CHARACTERS, shown
from service.plans import errors as plan_errors
from service.problem_schemas import BrokenBound, Problem

PROBLEM_TYPE = "urn:tidegate:problem:"
MEDIA_TYPE = "application/problem+json"
MOST_ERRORS = 20
"""Most fields that one problem names; a body may be wrong in any number of places."""
STORAGE_CODE = "storage_unavailable"
SOURCE_TAGS = {"recording", "device"}
"""What pydantic puts into the path of a source's field: the kind, which is no field."""

STATUS_OF: Mapping[type[Exception], tuple[int, str]] = {
    engine_errors.InvalidValueError: (422, "A value is out of its bound"),
    engine_errors.CalibrationError: (422, "The calibration cannot be true"),
    engine_errors.RecordingError: (422, "The recording cannot be read"),
    engine_errors.ModelError: (409, "The model cannot be used here"),
    engine_errors.CommandRefusedError: (409, "The engine will not do that now"),
    engine_errors.RuntimeMissingError: (503, "The OpenNI2 runtime is missing"),
    engine_errors.SourceLostError: (503, "The camera does not answer"),
    engine_errors.BeamLineError: (503, "The beam line does not answer"),
    JournalError: (503, "Transitions cannot be kept safe from a kill"),
    errors.BoundError: (422, "A value is out of its bound"),
    errors.NotFoundError: (404, "There is no such thing"),
    errors.SessionActiveError: (409, "Another session is open"),
    errors.SessionStateError: (409, "The session is not in a state for that"),
    errors.ServiceStoppingError: (503, "The service is stopping"),
    errors.QaActiveError: (409, "A QA run is under way"),
    errors.QaStateError: (409, "The QA run is not in a state for that"),
    errors.QaOverdueError: (409, "The daily QA is due"),
    errors.IdempotencyError: (409, "The Idempotency-Key was used for another request"),
    errors.IdempotencyInProgressError: (409, "The first request with this Idempotency-Key goes on"),
    errors.PreconditionFailedError: (412, "It was changed since"),
    errors.NotAcceptableError: (406, "No such media type"),
    errors.StartError: (422, "The session's source cannot be used"),
    errors.EngineTimeoutError: (503, "The engine did not answer in time"),
    errors.EngineProcessError: (503, "The engine's process is not there"),
    errors.PictureMissingError: (404, "There is no picture yet"),
    errors.MeshMissingError: (404, "There is no surface yet"),
    errors.SamplesRemovedError: (404, "The samples are not there any more"),
    errors.StorageLowError: (507, "There is no room for another session"),
    errors.StorageUnwritableError: (503, "The disk takes nothing"),
    errors.AuditBusyError: (409, "The audit is being verified already"),
    errors.MediaTypeError: (415, "The body must be JSON"),
    errors.NotLoggedInError: (401, "Nobody is logged in"),
    errors.LoginFailedError: (401, "The log-in was refused"),
    errors.StreamFullError: (503, "Too many watch the live stream"),
    errors.LockedOutError: (429, "Too many log-ins have failed"),
    errors.PasswordDeskFullError: (503, "Too many log-ins at once"),
    errors.WrongPasswordError: (422, "The old password is wrong"),
    errors.PermissionMissingError: (403, "That is not permitted"),
    errors.PasswordChangeDueError: (403, "The password has to be changed first"),
    errors.OriginRefusedError: (403, "Another page asks"),
    errors.OperatorMismatchError: (422, "The operator is somebody else"),
    errors.NameTakenError: (409, "The name is taken"),
    errors.LastAdminError: (409, "The last administrator stays"),
    errors.LocalLoginRefusedError: (403, "This account logs in elsewhere"),
    errors.OutsideUserError: (409, "The account is kept elsewhere"),
    plan_errors.PlanError: (422, "The file is no plan that can be used"),
    plan_errors.PlanConflictError: (409, "Another plan has this UID"),
    plan_errors.PlanGatingError: (409, "The window is not of the plan's technique"),
    plan_errors.PlanRejectedError: (409, "The plan was rejected"),
    plan_errors.PlanContradictedError: (409, "A later file contradicts the plan"),
    plan_errors.FractionDoneError: (409, "The fraction was begun before"),
    plan_errors.OverrideNotPersonalError: (403, "A person has to decide that"),
    plan_errors.PlanBusyError: (503, "Enough plans are being read"),
    SQLAlchemyError: (503, "The database does not answer"),
}
HTTP_CODES = {
    400: "bad_request",
    401: "not_logged_in",
    403: "permission_missing",
    404: "not_found",
    405: "method_not_allowed",
    406: "not_acceptable",
    408: "request_timeout",
    412: "precondition_failed",
    413: "body_too_large",
    414: "url_too_long",
    415: "media_type",
    421: "host_refused",
    431: "headers_too_large",
    501: "not_implemented",
}


def status_of(kind: type[Exception]) -> int:
    """Return the HTTP status of an error by the table; 500 for what is not in it."""
    return next((STATUS_OF[one][0] for one in kind.__mro__ if one in STATUS_OF), 500)


def code_of(kind: type[Exception]) -> str:
    """Return the stable code that an error has in a problem."""
    if issubclass(kind, SQLAlchemyError):
        return STORAGE_CODE
    return kind.code if issubclass(kind, TidegateError) else "internal_error"


def problem_of(error: Exception) -> Problem:
    """Turn any error into a problem; what is not in the table says nothing about its inside."""
    if isinstance(error, RequestValidationError):
        return _validation_problem(error)
    if isinstance(error, HTTPException):
        return _http_problem(error)
    for kind in type(error).__mro__:
        if kind in STATUS_OF:
            return _table_problem(error, *STATUS_OF[kind])
    return _problem(500, "internal_error", "Tidegate failed", "an unexpected error; it is in the service's log")


def problem_response(problem: Problem, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Answer with a problem."""
    return JSONResponse(
        problem.model_dump(exclude_none=True),
        status_code=problem.status,
        media_type=MEDIA_TYPE,
        headers=None if headers is None else dict(headers),
    )


def _table_problem(error: Exception, status: int, title: str) -> Problem:
    if isinstance(error, SQLAlchemyError):
        return _problem(status, STORAGE_CODE, title, "it may have been done all the same: look, and ask again")
    code = error.code if isinstance(error, TidegateError) else "error"
    found = {name: getattr(error, name, None) for name in ("field", "value", "bound")}
    return _problem(status, code, title, str(error), **found)


def _http_problem(error: HTTPException) -> Problem:
    code = HTTP_CODES.get(error.status_code, "http_error")
    extra = getattr(error, "problem_fields", {})
    return _problem(error.status_code, code, str(error.detail), str(error.detail), **extra)


def _validation_problem(error: RequestValidationError) -> Problem:
    """Name every field that is wrong, up to a bound; the first as `field`, `value` and `bound`, too."""
    broken = [_broken(one) for one in error.errors()[:MOST_ERRORS]]
    first = broken[0]
    problem = _problem(
        422,
        "invalid_value",
        "A value is out of its bound",
        f"{first.field}: {first.bound}",
        field=first.field,
        value=first.value,
        bound=first.bound,
    )
    return problem.model_copy(update={"errors": broken})


def _broken(error: Mapping[str, Any]) -> BrokenBound:
    context = error.get("ctx", {})
    place, *rest = error["loc"]
    parts = [str(part)[:SHOWN_CHARACTERS] for part in rest if place != "body" or part not in SOURCE_TAGS]
    if error["type"] == "json_invalid":
        parts = ["body"]
    if error["type"] == "inconsistent":
        field, value, bound = [*parts, str(context["field"])], str(context["value"]), str(context["bound"])
    else:
        field, value, bound = parts, _offered(error), _bound(str(error["msg"]))
    return BrokenBound(field=".".join(field) or "body", value=value, bound=bound)


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
) -> Problem:
    return Problem(
        type=f"{PROBLEM_TYPE}{code}",
        title=title,
        status=status,
        detail=detail,
        code=code,
        field=field,
        value=value,
        bound=bound,
    )
