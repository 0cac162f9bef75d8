"""A virtual RealSense: librealsense's software device in whatever process is given its environment.

It plays a virtual Xtion: each fault of a :class:`~tests.support.virtual_camera.camera.VirtualXtion` (lost, repeated and
late frames, clocks, covers, a pulled cable) reaches its frames.
"""

import json
from pathlib import Path
from typing import Any

from tests.support.virtual_camera.camera import VirtualXtion

SHIM = Path(__file__).parent / "shim"
ROOT = Path(__file__).parents[3]
SERIAL = "0123456789"
URI = f"realsense:{SERIAL}"


def cable(camera: VirtualXtion) -> Path:
    """Return the file that is there while the camera is plugged in: it outlives the camera's process."""
    return camera.path.with_suffix(".cable")


def settings(camera: VirtualXtion) -> dict[str, dict[str, float]]:
    """Return the options of its stereo module as they were at the "start" and at the "stop" of its stream."""
    return json.loads(cable(camera).with_suffix(".options").read_text())


def environment(camera: VirtualXtion, **faults: Any) -> dict[str, str]:
    """Return what makes a process see this camera as a RealSense, and no other.

    Parameters
    ----------
    faults
        ``usb`` its connection; ``busy`` another program has it; ``hangs`` a call, "stop" or "query"; ``domain`` of its
        times; ``clock_us`` added to them, before they wrap at 2^32; ``unit_m`` of its depth; ``serial``; ``infrared``
        whether it has such pictures; ``temperature_c`` that it tells; ``options`` whether its stereo module can be set
        (see `settings`).
    """
    own = camera.environment
    cable(camera).touch()
    given = {
        "block": own["VIRTUAL_XTION"],
        "redist": own["OPENNI2_REDIST"],
        "cable": str(cable(camera)),
        "calibration": str(camera.film.calibration_path),
        "serial": SERIAL,
        **faults,
    }
    return {"VIRTUAL_REALSENSE": json.dumps(given), "CAMERA_SDK_PATH": f"{SHIM}:{ROOT}"}
