"""References: a proposed one, the first one of a fraction as a document, and how far a later one lies from it.

Depths of the document are in the depth camera's frame, so they do not depend on the motion model that measured them.
The distance is measured from the first, never from the last: so small steps add up.
"""

import enum
import json
import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from engine.core.breath import WHOLE, SignalChoice
from engine.core.errors import InvalidValueError
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, FloatArray, frozen
from engine.core.position_check import PositionCheck
from engine.core.sentences import listed, say
from engine.core.strict_json import ROOT, StrictJson

SCHEMA = "tidegate.first-reference/2"
SCHEMA_WITHOUT_MOMENT = "tidegate.first-reference/1"
"""Documents of before the position check: at which moment of the breath they were set is not known."""
DIGITS = 4
MAX_DEPTH_MM = 20_000.0
MAX_VOLUME_L = 1_000.0
MAX_REGIONS = 10_000
NODES = NODE_ROWS * NODE_COLUMNS
_KEYS = ("schema", "calibration_sha256", "layout_sha256", "regions_mm", "surface_mm", "plane_mm", "volume_l")
_JSON = StrictJson(max_bytes=512 * 1024)


class ReferenceMoment(enum.StrEnum):
    """The moment of the breath that a reference is set at; the value is the stable code."""

    END_EXHALE = "end_exhale"
    END_INHALE = "end_inhale"
    NOW = "now"


class SignalLevel(NamedTuple):
    """Level of a gated signal [mm, l of the volume], positive towards the camera; NaN where it is not known."""

    choice: SignalChoice
    level: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceDistance:
    """A reference's distance from the fraction's first one, and the window's correction since.

    Attributes
    ----------
    moved_mm
        Displacement of the region's surface, root mean square over its nodes: shift, turn and shape together.
    shift_mm, height_mm
        Rigid shift of the region's middle in the plane of the first surface, and out of it, positive towards the
        camera.
    turn_deg, tilt_deg
        Rigid rotation in that plane, and out of it.
    shape_mm
        Root mean square of what a rigid movement leaves.
    levels
        Each gated signal of the reference, against the first one; the window's first signal first.
    correction
        How far the window was moved since the reference was set [mm, l of the volume], along its first signal.
    uncertainty_mm
        Standard uncertainty of the reference itself, of the first one too: what it adds to every point's motion.
    unknown
        Why the distance is not known; empty where it is.
    """

    moved_mm: float = math.nan
    shift_mm: float = math.nan
    height_mm: float = math.nan
    turn_deg: float = math.nan
    tilt_deg: float = math.nan
    shape_mm: float = math.nan
    levels: tuple[SignalLevel, ...] = ()
    correction: float = 0.0
    uncertainty_mm: float = math.nan
    unknown: str = ""

    @property
    def distance_mm(self) -> float | None:
        """The distance [mm]: the largest of the surface's displacement and the window's in any gated signal.

        Of the volume 0.1 l count as 1 mm. None where one of them is not known.
        """
        found = [self.moved_mm, *(abs(one.level) / one.choice.per_mm for one in self.corrected_levels)]
        return max(found) if not self.unknown and all(map(math.isfinite, found)) else None

    def is_within(self, most_mm: float | None) -> bool:
        """Whether the distance is known and at most ``most_mm``; None accepts any."""
        return most_mm is None or (self.distance_mm is not None and self.distance_mm <= most_mm)

    @property
    def corrected_levels(self) -> tuple[SignalLevel, ...]:
        """The levels from which the window counts: those of the reference, the first with the window's correction."""
        return tuple(
            one._replace(level=one.level + self.correction) if position == 0 else one
            for position, one in enumerate(self.levels)
        )

    def corrected(self, by: float) -> "ReferenceDistance":
        """Return the distance with the window moved by ``by`` [mm, l of the volume]."""
        return replace(self, correction=self.correction + by)

    @property
    def text(self) -> str:
        """The distance as a part of a sentence."""
        if self.distance_mm is None:
            return say(
                "at an unknown distance from the fraction's first ({unknown})",
                unknown=self.unknown or say("not all of it was measured"),
            )
        levels = listed(
            ", ",
            (
                say("{label} {level:+.2f} {unit}", label=one.choice.label, level=one.level, unit=one.choice.unit)
                for one in self.corrected_levels
            ),
        )
        of_surface = say(
            "shift {shift_mm:.1f} mm, height {height_mm:+.1f} mm, turn {turn_deg:.1f} deg, tilt {tilt_deg:.1f} deg, "
            "shape {shape_mm:.1f} mm",
            shift_mm=self.shift_mm,
            height_mm=self.height_mm,
            turn_deg=self.turn_deg,
            tilt_deg=self.tilt_deg,
            shape_mm=self.shape_mm,
        )
        return say(
            "{distance_mm:.2f} mm from the fraction's first ({parts})",
            distance_mm=self.distance_mm,
            parts=listed(", ", (of_surface, levels)),
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class ReferenceProposal:
    """The mean position at the last ends of exhale, or of inhale, by the gated signal.

    Attributes
    ----------
    level, scatter
        Level against the present reference, and its standard deviation over the breaths [mm, l of the volume].
    breaths
        How many breaths it is the mean of.
    percent
        Its place in the learned breathing range: 0 at the end of exhale, 100 at the end of inhale. None where the range
        is not known.
    distance
        How far it lies from the fraction's first reference; None without one.
    position_check
        Where it lies against the plan's position; None without one, while the gate is armed, and for the end of inhale.
    """

    moment: ReferenceMoment
    signal: SignalChoice = WHOLE
    level: float
    scatter: float
    breaths: int
    percent: float | None
    distance: ReferenceDistance | None = None
    position_check: PositionCheck | None = None


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FirstReference:
    """The first reference that a person confirmed.

    Attributes
    ----------
    calibration_sha256, layout_sha256
        Of the camera's calibration and of the region layout: only under the same ones are positions compared.
    regions_mm
        Mean depth of every region [mm], shape (r,), in the order of `engine.motion.stages.regions.RegionMeans`.
    surface_mm
        The region's surface at its nodes in the depth camera's frame [mm], shape (nodes, 3).
    plane_mm, volume_l
        Depth of the plane that its volume is measured from [mm], and the volume [l].
    moment
        The moment of the breath that it was set at; None where that was not recorded.
    """

    calibration_sha256: str
    layout_sha256: str
    regions_mm: FloatArray
    surface_mm: FloatArray
    plane_mm: float
    volume_l: float
    moment: ReferenceMoment | None = None

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        frozen(self.regions_mm)
        frozen(self.surface_mm)

    def to_json(self) -> str:
        """Return the document; lengths to a ten-thousandth of a millimetre, null for NaN."""
        return json.dumps(
            {
                "schema": SCHEMA,
                "calibration_sha256": self.calibration_sha256,
                "layout_sha256": self.layout_sha256,
                "regions_mm": _listed(self.regions_mm),
                "surface_mm": _listed(self.surface_mm.ravel()),
                "plane_mm": round(self.plane_mm, DIGITS),
                "volume_l": self.volume_l,
                "moment": None if self.moment is None else self.moment.value,
            },
            allow_nan=False,
        )


def read_first_reference(text: str) -> FirstReference:
    """Read a document; raise InvalidValueError, with the field, for one that is damaged."""
    fields = _JSON.fields(ROOT, _JSON.parse(text.encode()), required=_KEYS, optional=("moment",))
    if fields["schema"] not in {SCHEMA, SCHEMA_WITHOUT_MOMENT}:
        raise InvalidValueError("schema", fields["schema"], SCHEMA)
    surface = _JSON.items("surface_mm", fields["surface_mm"], 3 * NODES, 3 * NODES)
    regions = _JSON.items("regions_mm", fields["regions_mm"], 1, MAX_REGIONS)
    return FirstReference(
        calibration_sha256=_JSON.name("calibration_sha256", fields["calibration_sha256"]),
        layout_sha256=_JSON.name("layout_sha256", fields["layout_sha256"]),
        regions_mm=_numbers("regions_mm", regions),
        surface_mm=_numbers("surface_mm", surface).reshape(NODES, 3),
        plane_mm=_JSON.number("plane_mm", fields["plane_mm"], 0.0, MAX_DEPTH_MM),
        volume_l=_JSON.number("volume_l", fields["volume_l"], -MAX_VOLUME_L, MAX_VOLUME_L),
        moment=_moment(fields.get("moment")),
    )


def _moment(found: object) -> ReferenceMoment | None:
    if found is None:
        return None
    name = _JSON.name("moment", found)
    if name not in set(ReferenceMoment):
        raise InvalidValueError("moment", name, f"one of {', '.join(ReferenceMoment)}")
    return ReferenceMoment(name)


def _listed(values: FloatArray) -> list[float | None]:
    return [round(float(one), DIGITS) if np.isfinite(one) else None for one in values]


def _numbers(field: str, found: list[object]) -> FloatArray:
    """Return numbers as an array, NaN for null."""
    return np.array(
        [
            math.nan if one is None else _JSON.number(f"{field}[{index}]", one, -MAX_DEPTH_MM, MAX_DEPTH_MM)
            for index, one in enumerate(found)
        ]
    )
