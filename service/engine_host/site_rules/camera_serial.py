"""Rule: a calibration belongs to the camera with its serial number.

Another unit of the same make has another scale by per cents, and the region shifted, and nothing else shows it. In
clinical mode another camera is refused, and one that cannot be compared; otherwise the session carries a warning. A
recording does not contain the serial number of its camera, and the camera's own registration belongs to no unit.
"""

from dataclasses import dataclass
from functools import partial
from typing import Literal

from engine.calibration.camera_calibration import Calibration
from engine.capture import CheckedSource, LiveSource, SourceDescription
from engine.core.errors import CameraMismatchError
from service.core.settings.settings import Settings

SerialCode = Literal["camera_mismatch", "serial_unknown"]


@dataclass(frozen=True, slots=True, kw_only=True)
class SerialWarning:
    """What is wrong with the pair of calibration and camera; ``code`` is stable."""

    code: SerialCode
    text: str


def serial_warning(calibration: Calibration, camera: SourceDescription) -> SerialWarning | None:
    """Compare a calibration with the camera that was opened; None where they match, or cannot be compared at all."""
    if not camera.is_live or calibration.is_device_registration:
        return None
    if calibration.serial and calibration.serial != camera.serial:
        text = (
            f"the calibration is of the camera with serial number {calibration.serial}, and this one has "
            f"{camera.serial or 'none'}: calibrate this camera"
        )
        return SerialWarning(code="camera_mismatch", text=text)
    if not calibration.serial:
        text = (
            f"the calibration has no serial number, so that it cannot be compared with this camera's "
            f"({camera.serial or 'none'}): see that it belongs to it, and write it into the calibration"
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
