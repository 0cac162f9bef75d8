"""The file of a line laser's plane: ``tidegate.laser-plane/1``, read strictly; in the colour camera's frame.

A line laser lights a plane in space. Where the colour camera sees the line, the pixel's ray meets that plane in one
point: the point of the skin, in mm, without the depth sensor. The plane is valid only for the camera it was measured
with, and as long as laser and camera are not moved.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.core.errors import InvalidValueError
from engine.core.files import write_whole
from engine.core.frames import FloatArray, frozen
from engine.core.strict_json import ROOT, StrictJson

SCHEMA = "tidegate.laser-plane/1"
NEAREST_MM, FARTHEST_MM = 10.0, 3000.0
UNIT_TOLERANCE = 1e-3
_KEYS = ("schema", "camera", "normal", "distance_mm", "rms_mm", "pictures", "calibration_sha256")


class LaserPlaneError(InvalidValueError):
    """A laser's plane that cannot be true, or cannot be found; names field, value and bound."""

    code = "laser_plane_invalid"


STRICT = StrictJson(error=LaserPlaneError)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class LaserPlane:
    """All points X of the colour camera's frame with ``normal @ X == distance_mm``.

    Attributes
    ----------
    camera
        Name of the camera it was found with.
    normal
        Unit vector, away from the camera, shape (3,), float64.
    distance_mm
        Distance of the plane from the colour camera's centre.
    rms_mm
        Root mean square distance of the points it was found from; 0 when it is known by construction.
    pictures
        How many pictures it was found from; 0 when it is known by construction.
    calibration_sha256
        The calibration it was found with.
    """

    camera: str
    normal: FloatArray
    distance_mm: float
    rms_mm: float
    pictures: int
    calibration_sha256: str

    def __post_init__(self) -> None:
        """Make the normal read-only."""
        frozen(self.normal)

    def meet(self, rays: FloatArray) -> FloatArray:
        """Meet rays of unit depth with the plane.

        Parameters
        ----------
        rays
            (x/z, y/z, 1) in the colour camera's frame, shape (N, 3).

        Returns
        -------
        FloatArray
            Points of the colour camera's frame [mm], shape (N, 3); NaN for a ray that meets the plane nowhere in front.
        """
        across = rays @ self.normal
        with np.errstate(divide="ignore"):
            depth = self.distance_mm / across
        return np.asarray(np.where(across > 0.0, depth, np.nan)[:, None] * rays)

    def to_json(self) -> str:
        """Write the file's text."""
        document = {
            "schema": SCHEMA,
            "camera": self.camera,
            "normal": self.normal.tolist(),
            "distance_mm": self.distance_mm,
            "rms_mm": self.rms_mm,
            "pictures": self.pictures,
            "calibration_sha256": self.calibration_sha256,
        }
        return json.dumps(document, indent=2, sort_keys=True) + "\n"

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all."""
        write_whole(path, self.to_json().encode())


def load_plane(path: Path) -> LaserPlane:
    """Read a plane's file; raise LaserPlaneError, naming field, value and bound, if it is none."""
    root = STRICT.fields(ROOT, STRICT.load(path), required=_KEYS)
    if root["schema"] != SCHEMA:
        raise LaserPlaneError("schema", root["schema"], f'"{SCHEMA}"')
    normal = np.array(STRICT.vector("normal", root["normal"], 3, -1.001, 1.001))
    length = float(np.linalg.norm(normal))
    if abs(length - 1.0) > UNIT_TOLERANCE:
        raise LaserPlaneError("normal", root["normal"], f"of length 1 within {UNIT_TOLERANCE}, not {length:.4f}")
    sha256 = STRICT.name("calibration_sha256", root["calibration_sha256"])
    if len(sha256) != 64 or set(sha256) - set("0123456789abcdef"):
        raise LaserPlaneError("calibration_sha256", sha256, "64 hexadecimal digits")
    return LaserPlane(
        camera=STRICT.name("camera", root["camera"]),
        normal=normal / length,
        distance_mm=STRICT.number("distance_mm", root["distance_mm"], NEAREST_MM, FARTHEST_MM),
        rms_mm=STRICT.number("rms_mm", root["rms_mm"], 0.0, 100.0),
        pictures=STRICT.integer("pictures", root["pictures"], 0, 10_000),
        calibration_sha256=sha256,
    )
