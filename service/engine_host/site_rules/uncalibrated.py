"""Rule for sessions without a measured calibration: the camera registers depth to colour; every result is marked."""

from engine.calibration.camera_calibration import Calibration
from service.core.errors import BoundError
from service.core.schemas import sessions
from service.core.settings.settings import Settings

FIELD = "calibration_id"
FORBIDDEN = "a measured calibration: this site does not allow a camera's own registration"
WARNING = (
    "no calibration: the camera's own registration and nominal geometry are used; scale and alignment of this unit "
    "were not measured: not for treatment"
)


def kind_of(camera: str) -> sessions.CalibrationKind:
    """Return the kind of a calibration, by the name of its camera."""
    return "device registration" if Calibration.is_registration_name(camera) else "uploaded"


def warning_of(camera: str) -> str | None:
    """Return the note beside every result of such a session."""
    return WARNING if Calibration.is_registration_name(camera) else None


def described(camera: str) -> dict[str, object]:
    """Tell the audit."""
    warning = warning_of(camera)
    return {"calibration": kind_of(camera)} | ({} if warning is None else {"calibration_warning": warning})


def refuse_reserved_name(calibration: Calibration) -> None:
    """Refuse an uploaded calibration with the reserved camera name; raise BoundError."""
    if calibration.is_device_registration:
        bound = "another name: this one marks a camera's own registration"
        msg = f"camera must be {bound}"
        raise BoundError(msg, field="camera", value=calibration.camera, bound=bound)


def check_allowed(request: sessions.SessionRequest, settings: Settings) -> None:
    """Refuse a session on a camera's own registration where that cannot be, or may not; raise BoundError."""
    if isinstance(request.source, sessions.RecordingSource):
        bound = "a measured calibration: a recording does not contain whether the camera registered depth to colour"
    elif not settings.allow_device_registration:
        bound = FORBIDDEN
    else:
        return
    raise _refused(request.calibration_id or "missing", bound)


def check_still_allowed(calibration: Calibration, settings: Settings) -> None:
    """Refuse to start a session on a camera's registration if the site no longer allows it; raise BoundError."""
    if calibration.is_device_registration and not settings.allow_device_registration:
        raise _refused(calibration.camera, FORBIDDEN)


def _refused(value: str, bound: str) -> BoundError:
    msg = f"{FIELD} must be {bound}"
    return BoundError(msg, field=FIELD, value=value, bound=bound)
