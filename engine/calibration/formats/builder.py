"""What both dialects end in: a draft of our own document, with the names its values had where they came from."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from engine.calibration.camera_calibration import MAX_BASELINE_MM, MIN_BASELINE_MM, SCHEMA, Calibration, calibration_of
from engine.core.errors import CalibrationError
from engine.core.frames import FloatArray

Role = Literal["depth", "color"]
LengthUnit = Literal["mm", "m"]
ROLES: tuple[Role, Role] = ("depth", "color")
LENGTH_UNITS: tuple[LengthUnit, LengthUnit] = ("mm", "m")
MM_PER_M = 1000.0
# Lengths in mm and in m do not meet, so the size determines the unit; for sizes between or beyond (centimetres, squares
# of the board) it must be given.


@dataclass(frozen=True, slots=True, kw_only=True)
class ImportOptions:
    """Values that a foreign calibration may lack, given by the user; None where the files have to contain them.

    Parameters
    ----------
    camera
        The camera's name.
    first_camera
        Which camera comes first: M1 and R, T of OpenCV, or the first of two ``camera_info`` files.
    translation_unit
        Unit of OpenCV's T.
    image_size_px
        Width and height of both cameras' pictures.
    baseline_mm
        The colour camera's offset along x, where nothing else of the pose is known: T = (baseline, 0, 0), no rotation.
    depth_to_color
        The whole pose as in our own document.
    """

    camera: str | None = None
    first_camera: Role | None = None
    translation_unit: LengthUnit | None = None
    image_size_px: tuple[int, int] | None = None
    baseline_mm: float | None = None
    depth_to_color: dict[str, object] | None = None


@dataclass(slots=True, kw_only=True)
class Draft:
    """A document in our own format under construction; ``names`` maps its fields to those of the source files."""

    document: dict[str, object] = field(default_factory=lambda: {"schema": SCHEMA})
    names: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def put(self, our_name: str, value: object, their_name: str) -> None:
        """Put a value at a dotted place."""
        *parents, last = our_name.split(".")
        place: dict[str, object] = self.document
        for parent in parents:
            inner = place.setdefault(parent, {})
            assert isinstance(inner, dict)
            place = inner
        place[last] = value
        self.names[our_name] = their_name

    def put_camera(self, role: Role, entries: dict[str, float], their_matrix: str) -> None:
        """Put fx, fy, cx, cy."""
        for key, (row, column) in {"fx": (0, 0), "fy": (1, 1), "cx": (0, 2), "cy": (1, 2)}.items():
            self.put(f"{role}.{key}", entries[key], f"{their_matrix}[{row}][{column}]")

    def put_pose(self, rotation: FloatArray, translation_mm: FloatArray, *, names: tuple[str, str]) -> None:
        """Put the pose; ``names`` are those of rotation and translation."""
        self.put("depth_to_color.rotation", rotation.tolist(), names[0])
        self.put("depth_to_color.translation_mm", translation_mm.tolist(), names[1])

    def put_given_pose(self, options: ImportOptions) -> None:
        """Put the pose that a person gave."""
        if options.depth_to_color is not None:
            self.document["depth_to_color"] = options.depth_to_color
            return
        baseline_mm = options.baseline_mm
        if baseline_mm is None or not abs(baseline_mm) <= MAX_BASELINE_MM:
            bound = f"a number from {-MAX_BASELINE_MM:g} to {MAX_BASELINE_MM:g}"
            raise CalibrationError("baseline_mm", baseline_mm, bound)
        names = ("baseline_mm", "baseline_mm")
        self.put_pose(np.eye(3), np.array([baseline_mm, 0.0, 0.0]), names=names)
        self.notes.append(f"the pose is a baseline of {baseline_mm:g} mm along x, without rotation, as given")

    def finish(self) -> Calibration:
        """Check the document by our own rules; refusals use the names of the source files."""
        try:
            return calibration_of(self.document)
        except CalibrationError as error:
            known = [name for name in self.names if error.field == name or error.field.startswith(f"{name}[")]
            if not known:
                raise
            theirs = self.names[known[0]] + error.field.removeprefix(known[0])
            raise CalibrationError(theirs, _Shown(error.value), error.bound) from error


def length_in_mm(name: str, values: FloatArray, unit: LengthUnit | None, notes: list[str]) -> FloatArray:
    """Read a translation, shape (3,), in mm whatever its unit; refuse what could be either."""
    length = float(np.linalg.norm(values))
    if unit is None and MIN_BASELINE_MM <= length <= MAX_BASELINE_MM:
        unit = "mm"
    elif unit is None and MIN_BASELINE_MM <= length * MM_PER_M <= MAX_BASELINE_MM:
        unit = "m"
        notes.append(f"{name} is {length:g} long: taken as metres")
    if unit is None:
        bound = (
            f"{MIN_BASELINE_MM:g} to {MAX_BASELINE_MM:g} mm long, in mm or in m; "
            "say translation_unit (mm or m) if it is right"
        )
        raise CalibrationError(name, f"{length:g} long", bound)
    return values * (MM_PER_M if unit == "m" else 1.0)


class _Shown:
    """A value that was shown already: shown again as it is."""

    def __init__(self, text: str) -> None:
        self._text = text

    def __repr__(self) -> str:
        return self._text
