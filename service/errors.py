"""Errors of the service, each with a code that is stable; ``service.problems`` says what becomes of them in HTTP."""

from collections.abc import Mapping
from typing import ClassVar

from engine.errors import TidegateError

SHOWN_CHARACTERS = 80


def shown(value: object) -> str:
    """Show a value in a problem, bounded."""
    text = repr(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."


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
