"""The camera calibration file: ``tidegate.calibration/1``, read strictly.

A calibration turns pixels into millimetres, so a wrong one moves the beam. Every number is bounded, unknown and
missing keys are refused, and each refusal names the field, the value and the bound.
"""

import hashlib
import json
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from engine.core.errors import CalibrationError
from engine.core.geometry import Intrinsics, RigidTransform
from engine.core.strict_json import ROOT, StrictJson

SCHEMA = "tidegate.calibration/1"
MIN_BASELINE_MM, MAX_BASELINE_MM = 5.0, 200.0
SAME_PLACE_MM = 1e-6
"""Two cameras in one housing are in one place, or 5 to 200 mm apart; the same digits in metres are 0.005 to 0.2."""
JACOBIAN_STEPS = 65
ROTATION_TOLERANCE = 1e-3
REGISTRATION_NAME = "device registration"
"""Prefix of the camera's name in a nominal calibration, for a device that registers depth to colour itself."""
FACTORY_NAME = "device calibration"
"""Prefix of the camera's name in the calibration that a device has from its maker."""
NARROWEST_RAD, WIDEST_RAD = 0.3, 1.9
STRICT = StrictJson(error=CalibrationError)


@dataclass(frozen=True, slots=True, kw_only=True)
class DepthCorrection:
    """Per-unit correction of the depth scale: ``z = scale * reading + offset_mm``."""

    scale: float
    offset_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Disparity:
    """Projector baseline [mm] and step of the disparity [px], to undo the sensor's quantisation."""

    baseline_mm: float
    step_px: float


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Calibration:
    """Both cameras, the pose between them and, where measured, this unit's depth correction.

    ``serial`` is the serial number of the camera that was calibrated; empty where it is not known.
    """

    camera: str
    depth: Intrinsics
    color: Intrinsics
    color_from_depth: RigidTransform
    depth_correction: DepthCorrection | None = None
    disparity: Disparity | None = None
    serial: str = ""

    def to_json(self) -> str:
        """Return the canonical text: the content of the file and the input of :attr:`sha256`."""
        document: dict[str, object] = {
            "schema": SCHEMA,
            "camera": self.camera,
            "depth": _camera_document(self.depth),
            "color": _camera_document(self.color),
            "depth_to_color": {
                "rotation": self.color_from_depth.rotation.tolist(),
                "translation_mm": self.color_from_depth.translation_mm.tolist(),
            },
        }
        if self.serial:
            document["serial"] = self.serial
        if self.depth_correction is not None:
            document["depth_correction"] = {
                "scale": self.depth_correction.scale,
                "offset_mm": self.depth_correction.offset_mm,
            }
        if self.disparity is not None:
            document["disparity"] = {
                "baseline_mm": self.disparity.baseline_mm,
                "step_px": self.disparity.step_px,
            }
        return json.dumps(document, indent=2, sort_keys=True) + "\n"

    def check_sizes(self, *, depth: tuple[int, ...], color: tuple[int, ...]) -> None:
        """Raise CalibrationError for pictures of another size than this calibration's, given by their array shapes."""
        near, far = self.depth, self.color
        if depth[:2] == (near.height, near.width) and color[:2] == (far.height, far.width):
            return
        for name, camera, shape in (("depth", self.depth, depth), ("color", self.color, color)):
            for field, wanted, given in (("width", camera.width, shape[1]), ("height", camera.height, shape[0])):
                if wanted != given:
                    raise CalibrationError(f"{name}.{field}", wanted, f"{given}, as the camera's pictures are")

    @staticmethod
    def is_built_in_name(camera: str) -> bool:
        """Whether this name marks what a device brings itself: its registration, or its maker's calibration."""
        return camera.startswith((REGISTRATION_NAME, FACTORY_NAME))

    @property
    def is_built_in(self) -> bool:
        """Whether nothing was measured on this unit here: the device's registration, or its maker's calibration."""
        return self.is_built_in_name(self.camera)

    @property
    def is_device_registration(self) -> bool:
        """Whether this is the nominal geometry of a device's own registration, and nothing was measured."""
        return self.camera.startswith(REGISTRATION_NAME)

    def of_mirrored_pictures(self) -> "Calibration":
        """Return the calibration for pictures that are mirrored against those of this one: x points the other way."""
        flip = np.diag([-1.0, 1.0, 1.0])
        pose = self.color_from_depth
        return replace(
            self,
            depth=_mirrored(self.depth),
            color=_mirrored(self.color),
            color_from_depth=RigidTransform(
                rotation=flip @ pose.rotation @ flip, translation_mm=flip @ pose.translation_mm
            ),
        )

    @property
    def sha256(self) -> str:
        """Identity of this calibration, hexadecimal."""
        return hashlib.sha256(self.to_json().encode()).hexdigest()


def _mirrored(camera: Intrinsics) -> Intrinsics:
    k1, k2, p1, p2, k3 = camera.distortion
    return replace(camera, cx=camera.width - 1.0 - camera.cx, distortion=(k1, k2, p1, -p2, k3))


def nominal_calibration(
    device: str, *, size_px: tuple[int, int], field_of_view_rad: tuple[float, float]
) -> Calibration:
    """Make the calibration of a device that registers depth to colour itself: two equal cameras in one place.

    Parameters
    ----------
    device
        The device's name.
    size_px, field_of_view_rad
        Width and height of its colour pictures, and their angles; registered depth is seen as colour is.

    Raises
    ------
    CalibrationError
        No such angles.
    """
    for axis, angle in zip(("horizontal", "vertical"), field_of_view_rad, strict=True):
        if not NARROWEST_RAD <= angle <= WIDEST_RAD:
            bound = f"from {NARROWEST_RAD:g} to {WIDEST_RAD:g} rad"
            raise CalibrationError(f"{axis} field of view of {device}", angle, bound)
    (width, height), angles = size_px, field_of_view_rad
    camera = Intrinsics(
        width=width,
        height=height,
        fx=round(width / 2.0 / math.tan(angles[0] / 2.0), 4),
        fy=round(height / 2.0 / math.tan(angles[1] / 2.0), 4),
        cx=(width - 1) / 2.0,
        cy=(height - 1) / 2.0,
    )
    name = f"{REGISTRATION_NAME}: {''.join(letter for letter in device if letter.isprintable())}"[:80]
    return Calibration(
        camera=name,
        depth=camera,
        color=camera,
        color_from_depth=RigidTransform(rotation=np.eye(3), translation_mm=np.zeros(3)),
    )


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration file.

    Raises
    ------
    CalibrationError
        The file cannot be read or is not a calibration; names field, value and bound.
    """
    return parse_calibration(STRICT.read_bytes(Path(path)))


def parse_calibration(text: bytes) -> Calibration:
    """Parse and check a calibration document.

    Raises
    ------
    CalibrationError
        Not such a document; names field, value and bound.
    """
    return calibration_of(STRICT.parse(text))


def calibration_of(document: object) -> Calibration:
    """Check a document that is parsed already; raise CalibrationError."""
    root = STRICT.fields(
        ROOT,
        document,
        required=("schema", "camera", "depth", "color", "depth_to_color"),
        optional=("depth_correction", "disparity", "serial"),
    )
    if root["schema"] != SCHEMA:
        raise CalibrationError("schema", root["schema"], f'"{SCHEMA}"')
    correction = root.get("depth_correction")
    disparity = root.get("disparity")
    return Calibration(
        camera=STRICT.name("camera", root["camera"]),
        serial=STRICT.name("serial", root["serial"]) if "serial" in root else "",
        depth=_camera("depth", root["depth"]),
        color=_camera("color", root["color"]),
        color_from_depth=_pose("depth_to_color", root["depth_to_color"]),
        depth_correction=None if correction is None else _depth_correction("depth_correction", correction),
        disparity=None if disparity is None else _disparity("disparity", disparity),
    )


def _camera(field: str, value: object) -> Intrinsics:
    camera = STRICT.fields(field, value, required=("width", "height", "fx", "fy", "cx", "cy", "distortion"))
    width = STRICT.integer(f"{field}.width", camera["width"], 160, 4096)
    height = STRICT.integer(f"{field}.height", camera["height"], 120, 4096)
    focal = {key: STRICT.number(f"{field}.{key}", camera[key], 0.3 * width, 5.0 * width) for key in ("fx", "fy")}
    if not 0.8 <= focal["fx"] / focal["fy"] <= 1.25:
        raise CalibrationError(f"{field}.fy", focal["fy"], f"within 25 % of {field}.fx ({focal['fx']})")
    k1, k2, p1, p2, k3 = STRICT.vector(f"{field}.distortion", camera["distortion"], 5, -10.0, 10.0)
    intrinsics = Intrinsics(
        width=width,
        height=height,
        fx=focal["fx"],
        fy=focal["fy"],
        cx=STRICT.number(f"{field}.cx", camera["cx"], 0.0, width - 1.0),
        cy=STRICT.number(f"{field}.cy", camera["cy"], 0.0, height - 1.0),
        distortion=(k1, k2, p1, p2, k3),
    )
    least = least_magnification(intrinsics)
    if not least > 0.0:
        bound = f"a distortion that keeps the picture's points in their order: its Jacobian is {least:.3g} at the least"
        raise CalibrationError(f"{field}.distortion", camera["distortion"], f"{bound}, and has to stay above 0")
    return intrinsics


def least_magnification(camera: Intrinsics) -> float:
    """Return the least determinant of the distortion's Jacobian over the picture: 1 without distortion.

    Where it is not above 0 two places of the scene have the same pixel, as with the coefficients of another lens model.
    """
    columns = (np.linspace(0.0, camera.width - 1.0, JACOBIAN_STEPS) - camera.cx) / camera.fx
    rows = (np.linspace(0.0, camera.height - 1.0, JACOBIAN_STEPS) - camera.cy) / camera.fy
    x, y = np.meshgrid(columns, rows)
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x**2 + y**2
    radial, slope = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2.0 * k2 + 3.0 * k3 * r2)
    across = 2.0 * (x * y * slope + p1 * x + p2 * y)
    along_x = radial + 2.0 * x**2 * slope + 2.0 * p1 * y + 6.0 * p2 * x
    along_y = radial + 2.0 * y**2 * slope + 6.0 * p1 * y + 2.0 * p2 * x
    return float((along_x * along_y - across**2).min())


def _pose(field: str, value: object) -> RigidTransform:
    pose = STRICT.fields(field, value, required=("rotation", "translation_mm"))
    rows = pose["rotation"]
    if not isinstance(rows, list) or len(rows) != 3:
        raise CalibrationError(f"{field}.rotation", rows, "3 rows of 3 numbers")
    rotation = np.array([STRICT.vector(f"{field}.rotation[{i}]", row, 3, -1.001, 1.001) for i, row in enumerate(rows)])
    skew = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if skew > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0.0:
        raise CalibrationError(
            f"{field}.rotation",
            rotation.tolist(),
            f"a rotation (orthonormal within {ROTATION_TOLERANCE}, determinant 1)",
        )
    translation = np.array(
        STRICT.vector(f"{field}.translation_mm", pose["translation_mm"], 3, -MAX_BASELINE_MM, MAX_BASELINE_MM)
    )
    baseline = float(np.linalg.norm(translation))
    if not (baseline <= SAME_PLACE_MM or MIN_BASELINE_MM <= baseline <= MAX_BASELINE_MM):
        bound = f"0 or {MIN_BASELINE_MM:g} to {MAX_BASELINE_MM:g} mm long: two cameras in one housing; is it in metres?"
        raise CalibrationError(f"{field}.translation_mm", f"{baseline:g} long", bound)
    return RigidTransform(rotation=rotation, translation_mm=translation)


def _depth_correction(field: str, value: object) -> DepthCorrection:
    correction = STRICT.fields(field, value, required=("scale", "offset_mm"))
    return DepthCorrection(
        scale=STRICT.number(f"{field}.scale", correction["scale"], 0.8, 1.25),
        offset_mm=STRICT.number(f"{field}.offset_mm", correction["offset_mm"], -100.0, 100.0),
    )


def _disparity(field: str, value: object) -> Disparity:
    disparity = STRICT.fields(field, value, required=("baseline_mm", "step_px"))
    return Disparity(
        baseline_mm=STRICT.number(f"{field}.baseline_mm", disparity["baseline_mm"], 10.0, 500.0),
        step_px=STRICT.number(f"{field}.step_px", disparity["step_px"], 0.001, 1.0),
    )


def _camera_document(camera: Intrinsics) -> dict[str, object]:
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "distortion": list(camera.distortion),
    }
