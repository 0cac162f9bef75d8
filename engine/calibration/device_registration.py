"""The nominal calibration of a camera that moves its depth into the colour view itself (device registration)."""

from engine.calibration.camera_calibration import Calibration, nominal_calibration
from engine.capture import drivers


def registered_calibration(uri: str) -> Calibration | None:
    """Return the nominal calibration of a live camera that registers depth to colour itself; None if it cannot.

    Do not call it for a camera that a source has open: an SDK may share the device between both.

    Raises
    ------
    RuntimeMissingError, SourceLostError
        No SDK, or no such camera.
    CalibrationError
        The camera reports an impossible field of view.
    """
    view = drivers.registered_view(uri)
    if view is None:
        return None
    return nominal_calibration(view.name, size_px=view.size_px, field_of_view_rad=view.field_of_view_rad)
