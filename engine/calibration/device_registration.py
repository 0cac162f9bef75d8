"""The calibration that a camera brings itself: its registration of depth to colour, or its maker's calibration."""

from engine.calibration.camera_calibration import FACTORY_NAME, Calibration, nominal_calibration, parse_calibration
from engine.capture import drivers


def built_in_calibration(uri: str) -> Calibration | None:
    """Return what a live camera brings itself; None where it neither registers depth to colour nor has a calibration.

    Do not call it for a camera that a source has open: an SDK may share the device between both.

    Raises
    ------
    RuntimeMissingError, SourceLostError
        No SDK, or no such camera.
    CalibrationError
        The camera reports an impossible field of view, or an impossible calibration.
    """
    view = drivers.registered_view(uri)
    if view is not None:
        return nominal_calibration(view.name, size_px=view.size_px, field_of_view_rad=view.field_of_view_rad)
    made = drivers.factory_calibration(uri)
    if made is None:
        return None
    name = f"{FACTORY_NAME}: {''.join(letter for letter in made.camera if letter.isprintable())}"[:80]
    calibration = Calibration(
        camera=name, depth=made.depth, color=made.color, color_from_depth=made.color_from_depth, serial=made.serial
    )
    # Read as an uploaded one is: every number of it has the same bounds.
    return parse_calibration(calibration.to_json().encode())
