"""Rules for calibrations: a calibration belongs to the camera with its serial number; without one, results are marked.

Another unit of the same make has another scale by per cents, and the region shifted, and nothing else shows it. In
clinical mode another camera is refused, and one that cannot be compared; otherwise the session carries a warning. A
recording is compared where it has its camera's serial number; the camera's own registration belongs to no unit.
Without a measured calibration the camera registers depth to colour.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

from engine.calibration import FACTORY_NAME, Calibration
from engine.capture import CheckedSource, LiveSource, SourceDescription
from engine.core.errors import CameraMismatchError
from engine.core.sentences import say
from service.core.errors import BoundError
from service.core.schemas import sessions
from service.core.settings.settings import Settings

SerialCode = Literal["camera_mismatch", "serial_unknown"]
FIELD = "calibration_id"
FORBIDDEN = "a measured calibration: this site does not allow a camera's own registration"
WARNING = say(
    "no calibration: the camera's own registration and nominal geometry are used; scale and alignment of this unit "
    "were not measured: not for treatment"
)
FACTORY_WARNING = say(
    "the camera's calibration by its maker is used; scale and alignment of this unit were not measured here: not for "
    "treatment"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class SerialWarning:
    """What is wrong with the pair of calibration and camera; ``code`` is stable."""

    code: SerialCode
    text: str


def serial_warning(calibration: Calibration, camera: SourceDescription) -> SerialWarning | None:
    """Compare a calibration with the camera that was opened; None where they match, or cannot be compared at all."""
    if calibration.is_device_registration or not (camera.is_live or (camera.serial and calibration.serial)):
        return None
    if calibration.serial != camera.serial and not camera.is_live:
        text = say(
            "the calibration is of the camera with serial number {serial}, and this recording is of {present}: "
            "take that camera's calibration",
            serial=calibration.serial,
            present=camera.serial,
        )
        return SerialWarning(code="camera_mismatch", text=text)
    if calibration.serial and calibration.serial != camera.serial:
        text = say(
            "the calibration is of the camera with serial number {serial}, and this one has {present}: "
            "calibrate this camera",
            serial=calibration.serial,
            present=camera.serial or say("none"),
        )
        return SerialWarning(code="camera_mismatch", text=text)
    if not calibration.serial:
        text = say(
            "the calibration has no serial number, so that it cannot be compared with this camera's ({present}): "
            "see that it belongs to it, and write it into the calibration",
            present=camera.serial or say("none"),
        )
        return SerialWarning(code="serial_unknown", text=text)
    return None


def checked_camera(source: LiveSource, calibration: Calibration, settings: Settings) -> LiveSource:
    """Return a source that refuses, in clinical mode, a camera that is not known to be the calibrated one."""
    if settings.mode != "clinical":
        return source
    return CheckedSource(source, partial(_refuse_mismatch, calibration))


def _refuse_mismatch(calibration: Calibration, camera: SourceDescription) -> None:
    warning = serial_warning(calibration, camera)
    if warning is not None:
        raise CameraMismatchError(warning.text)


def kind_of(camera: str) -> sessions.CalibrationKind:
    """Return the kind of a calibration, by the name of its camera."""
    if camera.startswith(FACTORY_NAME):
        return "device calibration"
    return "device registration" if Calibration.is_built_in_name(camera) else "uploaded"


def warning_of(camera: str) -> str | None:
    """Return the note beside every result of such a session."""
    if camera.startswith(FACTORY_NAME):
        return FACTORY_WARNING
    return WARNING if Calibration.is_built_in_name(camera) else None


def described(camera: str) -> dict[str, object]:
    """Tell the audit."""
    warning = warning_of(camera)
    return {"calibration": kind_of(camera)} | ({} if warning is None else {"calibration_warning": warning})


def refuse_reserved_name(calibration: Calibration) -> None:
    """Refuse an uploaded calibration with the reserved camera name; raise BoundError."""
    if calibration.is_built_in:
        bound = "another name: this one marks what a camera brings itself"
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
    if calibration.is_built_in and not settings.allow_device_registration:
        raise _refused(calibration.camera, FORBIDDEN)


def _refused(value: str, bound: str) -> BoundError:
    msg = f"{FIELD} must be {bound}"
    return BoundError(msg, field=FIELD, value=value, bound=bound)
