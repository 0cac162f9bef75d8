"""Maps every error to HTTP: the table of status and title, and the problem document (RFC 9457)."""

import re
from collections.abc import Mapping
from typing import Any

from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException

from engine.control import JournalError
from engine.core import errors as engine_errors
from engine.core.errors import TidegateError
from engine.core.sentences import Sentence
from service.core import errors
from service.core.errors import SHOWN_CHARACTERS, shown
from service.core.schemas.base import BrokenBound, Problem
from service.core.schemas.sentences import sentence_parts
from service.planning.rt_plan import errors as plan_errors
from service.web.problems.remedies import WHAT_TO_DO

PROBLEM_TYPE = "urn:tidegate:problem:"
MEDIA_TYPE = "application/problem+json"
MOST_ERRORS = 20
PLAIN = (
    (r"^(Input|String|List|Value) should (be )?", ""),
    (r"^have (at (least|most) \d+) (\w+)( after validation.*)?$", r"\1 \3"),
    (r"^match pattern", "a text of the pattern"),
)
"""What a library says of a value, as a bound that reads behind "must be"."""
"""Largest number of fields that one problem lists."""
STORAGE_CODE = "storage_unavailable"
SOURCE_TAGS = {"recording", "device"}
"""Discriminator values that pydantic inserts into the path of a source's field; they are not field names."""

STATUS_OF: Mapping[type[Exception], tuple[int, str]] = {
    engine_errors.InvalidValueError: (422, "A value is outside its bound"),
    engine_errors.CalibrationError: (422, "The calibration is invalid"),
    engine_errors.RecordingError: (422, "The recording cannot be read"),
    engine_errors.ModelError: (409, "The motion model cannot be used"),
    engine_errors.CommandRefusedError: (409, "The engine refuses the command"),
    engine_errors.HeadDirectionError: (409, "The head direction is missing or not confirmed"),
    engine_errors.ReferenceDistanceError: (409, "The reference would lie too far from the fraction's first"),
    engine_errors.ReasonMissingError: (409, "A written reason is needed"),
    engine_errors.CountersignatureError: (409, "A second person has not countersigned"),
    engine_errors.PositionUncheckedError: (409, "The patient's position is not checked and signed"),
    engine_errors.RuntimeMissingError: (503, "The camera's SDK is missing"),
    engine_errors.SourceLostError: (503, "The camera does not answer"),
    engine_errors.BeamLineError: (503, "The beam line does not answer"),
    JournalError: (503, "The transition journal cannot be written"),
    errors.BoundError: (422, "A value is outside its bound"),
    errors.NotFoundError: (404, "Not found"),
    errors.SessionActiveError: (409, "Another session is open"),
    errors.SessionStateError: (409, "The session's status does not allow this"),
    errors.ServiceStoppingError: (503, "The service is stopping"),
    errors.QaActiveError: (409, "A QA run is in progress"),
    errors.QaCodeError: (403, "A one-time code from the machine is needed"),
    errors.QaStateError: (409, "The QA run's status does not allow this"),
    errors.QaOverdueError: (409, "The daily QA is due"),
    errors.CameraLatencyError: (409, "The camera's latency has to be measured"),
    errors.IdempotencyError: (409, "The Idempotency-Key was used for another request"),
    errors.IdempotencyInProgressError: (409, "The first request with this Idempotency-Key is in progress"),
    errors.PreconditionFailedError: (412, "The resource was changed"),
    errors.NotAcceptableError: (406, "Media type not available"),
    errors.StartError: (422, "The session's source cannot be used"),
    errors.EngineTimeoutError: (503, "The engine did not answer in time"),
    errors.EngineProcessError: (503, "The engine process is not running"),
    errors.PictureMissingError: (404, "There is no picture yet"),
    errors.MeshMissingError: (404, "There is no surface yet"),
    errors.SamplesRemovedError: (404, "The samples were removed"),
    errors.StorageLowError: (507, "Not enough disk space for another session"),
    errors.StorageUnwritableError: (503, "The disk cannot be written"),
    errors.AuditBusyError: (409, "The audit log is already being verified"),
    errors.MediaTypeError: (415, "Media type not supported"),
    errors.NotLoggedInError: (401, "Not logged in"),
    errors.LoginFailedError: (401, "The log-in was refused"),
    errors.PairingRefusedError: (403, "The screen was not paired"),
    errors.StreamFullError: (503, "Too many clients of the live stream"),
    errors.LockedOutError: (429, "Too many failed log-ins"),
    errors.PasswordServiceBusyError: (503, "Too many log-ins at once"),
    errors.WrongPasswordError: (422, "The old password is wrong"),
    errors.SignerError: (422, "The signature was refused"),
    errors.SecondPersonError: (422, "The second person was refused"),
    errors.PermissionMissingError: (403, "Permission missing"),
    errors.PersonRequiredError: (403, "A person has to be logged in"),
    errors.PasswordChangeDueError: (403, "The password must be changed first"),
    errors.OriginRefusedError: (403, "Origin refused"),
    errors.OperatorMismatchError: (422, "The operator is another person"),
    errors.NameTakenError: (409, "The name is in use"),
    errors.LastAdminError: (409, "The last administrator cannot be removed"),
    errors.LocalLoginRefusedError: (403, "This account must log in at the identity provider"),
    errors.OutsideUserError: (409, "The account is managed by the identity provider"),
    plan_errors.PlanError: (422, "The file is not a usable plan"),
    plan_errors.PlanConflictError: (409, "Another plan has this UID"),
    plan_errors.PlanGatingError: (409, "The window does not match the plan's technique"),
    plan_errors.PlanPositionError: (409, "The patient's position does not match the plan"),
    plan_errors.PlanRejectedError: (409, "The plan was rejected"),
    plan_errors.PlanContradictedError: (409, "A later file contradicts the plan"),
    plan_errors.FractionDoneError: (409, "The fraction was started before"),
    plan_errors.OverrideNotPersonalError: (403, "A person must decide this"),
    plan_errors.PlanBusyError: (503, "Too many plans are being read"),
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
    """Return the HTTP status of an error class; 500 if it is not in the table."""
    return next((STATUS_OF[one][0] for one in kind.__mro__ if one in STATUS_OF), 500)


def code_of(kind: type[Exception]) -> str:
    """Return the stable code of an error class."""
    if issubclass(kind, SQLAlchemyError):
        return STORAGE_CODE
    return kind.code if issubclass(kind, TidegateError) else "internal_error"


def problem_of(error: Exception) -> Problem:
    """Convert any error to a problem; one that is not in the table becomes a 500 without internals."""
    if isinstance(error, RequestValidationError):
        return _validation_problem(error)
    if isinstance(error, HTTPException):
        return _http_problem(error)
    for kind in type(error).__mro__:
        if kind in STATUS_OF:
            return _table_problem(error, *STATUS_OF[kind])
    return _problem(500, "internal_error", "Internal error", "An unexpected error occurred; the service's log has it.")


def problem_response(problem: Problem, headers: Mapping[str, str] | None = None) -> JSONResponse:
    """Return the HTTP response of a problem."""
    return JSONResponse(
        problem.model_dump(exclude_none=True),
        status_code=problem.status,
        media_type=MEDIA_TYPE,
        headers=None if headers is None else dict(headers),
    )


def _table_problem(error: Exception, status: int, title: str) -> Problem:
    if isinstance(error, SQLAlchemyError):
        return _problem(status, STORAGE_CODE, title, "The request may have been carried out: check, then retry.")
    code = error.code if isinstance(error, TidegateError) else "error"
    found = {name: getattr(error, name, None) for name in ("field", "value", "bound")}
    said = error.args[0] if error.args and isinstance(error.args[0], Sentence) else str(error)
    return _problem(status, code, title, said, **found)


def _http_problem(error: HTTPException) -> Problem:
    code = HTTP_CODES.get(error.status_code, "http_error")
    extra = getattr(error, "problem_fields", {})
    return _problem(error.status_code, code, str(error.detail), str(error.detail), **extra)


def _validation_problem(error: RequestValidationError) -> Problem:
    """List every wrong field, up to MOST_ERRORS; the first one also as `field`, `value` and `bound`."""
    broken = [_broken(one) for one in error.errors()[:MOST_ERRORS]]
    first = broken[0]
    problem = _problem(
        422,
        "invalid_value",
        "A value is outside its bound",
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
    text = message.removeprefix("Value error, ")
    for pattern, words in PLAIN:
        text = re.sub(pattern, words, text)
    return "left out: the field is unknown" if text == "Extra inputs are not permitted" else text


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
        sentences=sentence_parts(detail) or None,
        code=code,
        field=field,
        value=value,
        bound=bound,
        remedy=WHAT_TO_DO.get(code),
    )
