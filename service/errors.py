"""Errors of the service, and the one table that turns errors into HTTP (RFC 9457 problems)."""

from collections.abc import Mapping
from typing import Any, ClassVar

from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from sqlalchemy.exc import SQLAlchemyError
from starlette.exceptions import HTTPException

from engine import errors as engine_errors
from engine.errors import TidegateError
from engine.transition_journal import JournalError
from service import schemas
from service.plans import errors as plan_errors

PROBLEM_TYPE = "urn:tidegate:problem:"
MEDIA_TYPE = "application/problem+json"
SHOWN_CHARACTERS = 80
MOST_ERRORS = 20
"""Most fields that one problem names; a body may be wrong in any number of places."""
STORAGE_CODE = "storage_unavailable"
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
        self.headers: Mapping[str, str] | None = None
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


class IdempotencyInProgressError(ServiceError):
    """The first request with this Idempotency-Key is still being worked on."""

    code = "idempotency_in_progress"

    def __init__(self, message: str, *, field: str | None = None, bound: str | None = None) -> None:
        super().__init__(message, field=field, bound=bound)
        self.headers = {"Retry-After": "1"}


class PreconditionFailedError(ServiceError):
    """It was changed since: ``If-Match`` names another state than the present one."""

    code = "precondition_failed"


class NotAcceptableError(ServiceError):
    """The answer has none of the media types that ``Accept`` asks for."""

    code = "not_acceptable"


class StartError(ServiceError):
    """The session's source could not be opened; the session is closed as failed."""

    code = "source_unusable"


class EngineTimeoutError(ServiceError):
    """The engine did not answer in time; the command was withdrawn."""

    code = "engine_timeout"


class EngineProcessError(ServiceError):
    """No session can begin: the engine's process does not start, or died."""

    code = "engine_missing"


class PictureMissingError(ServiceError):
    """There is no picture yet."""

    code = "picture_missing"


class MeshMissingError(ServiceError):
    """There is no surface of the newest frame."""

    code = "mesh_missing"


class SamplesRemovedError(ServiceError):
    """The session's samples are not there any more."""

    code = "samples_removed"


class StorageLowError(ServiceError):
    """There is no room for another session."""

    code = "storage_low"


class StorageUnwritableError(ServiceError):
    """The disk does not take what would be measured."""

    code = "storage_unwritable"


class AuditBusyError(ServiceError):
    """The audit is being verified already; a walk is work, and one is enough."""

    code = "audit_busy"


class MediaTypeError(ServiceError):
    """The body is not JSON by its Content-Type."""

    code = "media_type"


class NotLoggedInError(ServiceError):
    """Nobody is logged in, or the log-in, the key or the token is over."""

    code = "not_logged_in"

    def __init__(self) -> None:
        super().__init__("log in, or send a key: there is none, or it is not valid any more")
        self.headers = {"WWW-Authenticate": 'Bearer realm="tidegate"'}


class LoginFailedError(ServiceError):
    """The log-in was refused; nothing tells why."""

    code = "login_failed"

    def __init__(self) -> None:
        super().__init__("name or password is wrong, or the account may not log in")
        self.headers = {"WWW-Authenticate": 'Bearer realm="tidegate"'}


class StreamFullError(ServiceError):
    """As many watch the live stream as the site lets."""

    code = "stream_full"

    def __init__(self) -> None:
        super().__init__("every place at the live stream is taken")
        self.headers = {"Retry-After": "5"}


class LockedOutError(ServiceError):
    """Too many log-ins have failed for this name or from this address."""

    code = "locked_out"

    def __init__(self, wait_s: int) -> None:
        super().__init__(f"too many log-ins have failed: try again in {wait_s} s")
        self.headers = {"Retry-After": str(wait_s)}


class PasswordDeskFullError(ServiceError):
    """Too many passwords wait to be checked; the gate's machine has better things to do."""

    code = "login_busy"

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.headers = {"Retry-After": "1"}


class WrongPasswordError(ServiceError):
    """The old password is wrong."""

    code = "wrong_password"


class PermissionMissingError(ServiceError):
    """Whoever asks may not."""

    code = "permission_missing"


class PasswordChangeDueError(ServiceError):
    """The password was made by somebody else, and has to be changed first."""

    code = "password_change_due"


class OriginRefusedError(ServiceError):
    """A browser's call does not come from our own page."""

    code = "origin_refused"


class OperatorMismatchError(ServiceError):
    """A person asks in another one's name."""

    code = "operator_mismatch"


class NameTakenError(ServiceError):
    """Somebody has this name, or had it."""

    code = "name_taken"


class LastAdminError(ServiceError):
    """Nobody would be left who may administer."""

    code = "last_admin"


class LocalLoginRefusedError(ServiceError):
    """The password is right, and the site has this account log in at the identity provider."""

    code = "local_login_refused"


class OutsideUserError(ServiceError):
    """The account is kept by the hospital's identity provider, and is changed there."""

    code = "outside_user"


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
    BoundError: (422, "A value is out of its bound"),
    NotFoundError: (404, "There is no such thing"),
    SessionActiveError: (409, "Another session is open"),
    SessionStateError: (409, "The session is not in a state for that"),
    ServiceStoppingError: (503, "The service is stopping"),
    QaActiveError: (409, "A QA run is under way"),
    QaStateError: (409, "The QA run is not in a state for that"),
    QaOverdueError: (409, "The daily QA is due"),
    IdempotencyError: (409, "The Idempotency-Key was used for another request"),
    IdempotencyInProgressError: (409, "The first request with this Idempotency-Key goes on"),
    PreconditionFailedError: (412, "It was changed since"),
    NotAcceptableError: (406, "No such media type"),
    StartError: (422, "The session's source cannot be used"),
    EngineTimeoutError: (503, "The engine did not answer in time"),
    EngineProcessError: (503, "The engine's process is not there"),
    PictureMissingError: (404, "There is no picture yet"),
    MeshMissingError: (404, "There is no surface yet"),
    SamplesRemovedError: (404, "The samples are not there any more"),
    StorageLowError: (507, "There is no room for another session"),
    StorageUnwritableError: (503, "The disk takes nothing"),
    AuditBusyError: (409, "The audit is being verified already"),
    MediaTypeError: (415, "The body must be JSON"),
    NotLoggedInError: (401, "Nobody is logged in"),
    LoginFailedError: (401, "The log-in was refused"),
    StreamFullError: (503, "Too many watch the live stream"),
    LockedOutError: (429, "Too many log-ins have failed"),
    PasswordDeskFullError: (503, "Too many log-ins at once"),
    WrongPasswordError: (422, "The old password is wrong"),
    PermissionMissingError: (403, "That is not permitted"),
    PasswordChangeDueError: (403, "The password has to be changed first"),
    OriginRefusedError: (403, "Another page asks"),
    OperatorMismatchError: (422, "The operator is somebody else"),
    NameTakenError: (409, "The name is taken"),
    LastAdminError: (409, "The last administrator stays"),
    LocalLoginRefusedError: (403, "This account logs in elsewhere"),
    OutsideUserError: (409, "The account is kept elsewhere"),
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


def shown(value: object) -> str:
    """Show a value in a problem, bounded."""
    text = repr(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."


def status_of(kind: type[Exception]) -> int:
    """Return the HTTP status of an error by the table; 500 for what is not in it."""
    return next((STATUS_OF[one][0] for one in kind.__mro__ if one in STATUS_OF), 500)


def code_of(kind: type[Exception]) -> str:
    """Return the stable code that an error has in a problem."""
    if issubclass(kind, SQLAlchemyError):
        return STORAGE_CODE
    return kind.code if issubclass(kind, TidegateError) else "internal_error"


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
        return _problem(status, STORAGE_CODE, title, "nothing was changed; try again")
    code = error.code if isinstance(error, TidegateError) else "error"
    found = {name: getattr(error, name, None) for name in ("field", "value", "bound")}
    return _problem(status, code, title, str(error), **found)


def _http_problem(error: HTTPException) -> schemas.Problem:
    code = HTTP_CODES.get(error.status_code, "http_error")
    extra = getattr(error, "problem_fields", {})
    return _problem(error.status_code, code, str(error.detail), str(error.detail), **extra)


def _validation_problem(error: RequestValidationError) -> schemas.Problem:
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


def _broken(error: Mapping[str, Any]) -> schemas.BrokenBound:
    context = error.get("ctx", {})
    place, *rest = error["loc"]
    parts = [str(part)[:SHOWN_CHARACTERS] for part in rest if place != "body" or part not in SOURCE_TAGS]
    if error["type"] == "json_invalid":
        parts = ["body"]
    if error["type"] == "inconsistent":
        field, value, bound = [*parts, str(context["field"])], str(context["value"]), str(context["bound"])
    else:
        field, value, bound = parts, _offered(error), _bound(str(error["msg"]))
    return schemas.BrokenBound(field=".".join(field) or "body", value=value, bound=bound)


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
