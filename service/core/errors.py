"""Errors of the service, each with a stable code.

``service.web.problems.table`` maps them to HTTP. The first line of each docstring is published in the problem
catalogue.
"""

from collections.abc import Mapping
from typing import ClassVar

from engine.core.errors import TidegateError

SHOWN_CHARACTERS = 80


def shown(value: object) -> str:
    """Return the value as text for a problem, cut to 80 characters."""
    text = repr(value)
    return text if len(text) <= SHOWN_CHARACTERS else f"{text[: SHOWN_CHARACTERS - 3]}..."


class ServiceError(TidegateError):
    """An error of the service; may name a field, its value and the bound that the value broke."""

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
    """A value is outside a bound that the service checks: a site limit, an allowed folder, a cursor."""

    code = "invalid_value"


class NotFoundError(ServiceError):
    """The id or the path does not exist."""


class SessionActiveError(ServiceError):
    """Another session is created or running. There is one camera and one beam, so one session at a time is open."""


class SessionStateError(ServiceError):
    """The session's status does not allow this call."""


class ServiceStoppingError(ServiceError):
    """The service is shutting down."""


class QaActiveError(ServiceError):
    """A QA run uses the camera and the beam line."""


class QaCodeError(ServiceError):
    """The one-time code of a QA run on a real beam line is missing, wrong, expired or used."""


class QaStateError(ServiceError):
    """The QA run's status does not allow this call."""


class QaOverdueError(ServiceError):
    """The site requires a daily QA before arming, and the newest run is too old, failed, or missing."""


class CameraLatencyError(ServiceError):
    """Clinical mode requires a measured latency of this camera, and it is missing, too old, failed, or too large."""


class IdempotencyError(ServiceError):
    """The Idempotency-Key was used before with another body."""

    code = "idempotency_key_reused"


class IdempotencyInProgressError(ServiceError):
    """The first request with this Idempotency-Key is still in progress."""

    def __init__(self, message: str, *, field: str | None = None, bound: str | None = None) -> None:
        super().__init__(message, field=field, bound=bound)
        self.headers = {"Retry-After": "1"}


class PreconditionFailedError(ServiceError):
    """The resource was changed: ``If-Match`` does not match its present ETag."""


class NotAcceptableError(ServiceError):
    """The call cannot answer in any of the media types in ``Accept``."""


class StartError(ServiceError):
    """The session's camera or recording could not be opened; the session is closed as failed."""

    code = "source_unusable"


class EngineTimeoutError(ServiceError):
    """The engine did not answer in time; the command was cancelled."""


class EngineProcessError(ServiceError):
    """The engine process does not start, or has died; no session can start."""

    code = "engine_missing"


class PictureMissingError(ServiceError):
    """The session does not run, or no frame has arrived yet."""


class MeshMissingError(ServiceError):
    """The session does not run, or its newest frame was not measured."""


class SamplesRemovedError(ServiceError):
    """The session's samples were removed when their retention time ended."""


class StorageLowError(ServiceError):
    """The free disk space or the quota does not suffice for another session."""


class StorageUnwritableError(ServiceError):
    """The sample file cannot be written."""


class AuditBusyError(ServiceError):
    """A verification of the audit log is already in progress; one at a time is allowed."""


class MediaTypeError(ServiceError):
    """The Content-Type of the body is not one that the call accepts."""


class NotLoggedInError(ServiceError):
    """The request has no valid log-in, API key or token, or it has expired."""

    def __init__(self) -> None:
        super().__init__("Log in, or send a valid API key. The log-in or key is missing or has expired.")
        self.headers = {"WWW-Authenticate": 'Bearer realm="tidegate"'}


class LoginFailedError(ServiceError):
    """The log-in was refused; the answer does not say whether name or password is wrong."""

    def __init__(self) -> None:
        super().__init__("Name or password is wrong, or the account is disabled.")
        self.headers = {"WWW-Authenticate": 'Bearer realm="tidegate"'}


class StreamFullError(ServiceError):
    """The live stream has its maximum number of clients."""

    def __init__(self) -> None:
        super().__init__("The live stream has its maximum number of clients. Try again later.")
        self.headers = {"Retry-After": "5"}


class PairingRefusedError(ServiceError):
    """No pairing code is open at the console, or it is another one."""

    def __init__(self) -> None:
        super().__init__("the code is not the one that the console shows, or it has expired", field="code")


class LockedOutError(ServiceError):
    """Too many log-ins failed for this name or from this address."""

    def __init__(self, wait_s: int) -> None:
        super().__init__(f"Too many log-ins failed. Try again in {wait_s} s.")
        self.headers = {"Retry-After": str(wait_s)}


class PasswordServiceBusyError(ServiceError):
    """Too many password checks are waiting; they are limited so that the gate keeps its processor time."""

    code = "login_busy"

    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.headers = {"Retry-After": "1"}


class WrongPasswordError(ServiceError):
    """The old password is wrong."""


class SecondPersonError(ServiceError):
    """The second person's name or password is wrong, or that person may not countersign."""


class SignerError(ServiceError):
    """A report is signed with the person's own password, or with a log-in that was opened just before."""

    code = "signer_unconfirmed"


class PermissionMissingError(ServiceError):
    """The caller lacks the permission that the call needs."""


class PersonRequiredError(ServiceError):
    """A program made a call that only a person who has logged in may make."""


class PasswordChangeDueError(ServiceError):
    """The password was set by an administrator and must be changed first."""


class OriginRefusedError(ServiceError):
    """The call comes from a page of another origin."""


class OperatorMismatchError(ServiceError):
    """`operator` names another person than the one who is logged in."""


class NameTakenError(ServiceError):
    """The name is in use, or was used before; names are never reused."""


class LastAdminError(ServiceError):
    """The change would leave no active administrator."""


class LocalLoginRefusedError(ServiceError):
    """The password is right, but this account must log in at the identity provider."""


class OutsideUserError(ServiceError):
    """The account is managed by the identity provider and must be changed there."""
