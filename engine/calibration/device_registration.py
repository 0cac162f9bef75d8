"""The nominal calibration of a camera that moves its depth into the colour view itself (device registration)."""

from engine.calibration.camera_calibration import Calibration, nominal_calibration
from engine.capture.openni import c_api
from engine.capture.openni.device import OpenNiDevice

REGISTERED_SIZE_PX = (640, 480)


def registered_calibration(uri: str) -> Calibration | None:
    """Return the nominal calibration of a live device that registers depth to colour itself; None if it cannot.

    Do not call it for a device that a source has open: the runtime would share the device between both.

    Raises
    ------
    RuntimeMissingError, SourceLostError
        No runtime, or no such device.
    CalibrationError
        The device reports an impossible field of view.
    """
    c_api.runtime()
    device = OpenNiDevice(uri, is_file=False)
    try:
        if not device.can_register():
            return None
        return nominal_calibration(device.name, size_px=REGISTERED_SIZE_PX, field_of_view_rad=device.color_view_rad())
    finally:
        device.close()
