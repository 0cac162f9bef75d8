"""Camera calibration: the calibration file, sensor quantisation.

Foreign formats and the procedures that make a calibration.
"""

from typing import TYPE_CHECKING

from engine.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from engine.calibration.camera_calibration import (
        FACTORY_NAME as FACTORY_NAME,
        STRICT as STRICT,
        Calibration as Calibration,
        Disparity as Disparity,
        load_calibration as load_calibration,
        parse_calibration as parse_calibration,
    )
    from engine.calibration.camera_view import (
        CameraViewMeter as CameraViewMeter,
    )
    from engine.calibration.device_registration import (
        built_in_calibration as built_in_calibration,
    )
    from engine.calibration.laser_plane import (
        LaserPlane as LaserPlane,
        load_plane as load_plane,
    )
    from engine.calibration.quantisation import (
        DepthSteps as DepthSteps,
    )

__getattr__, __all__ = lazy_exports(__name__)
