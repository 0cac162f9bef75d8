"""The first reference of a fraction as a document, which outlives the engine: later ones are compared with it.

Depths in the depth camera's frame, so they do not depend on the motion model that measured them.
"""

import json
import math
from dataclasses import dataclass

import numpy as np

from engine.core.errors import InvalidValueError
from engine.core.frames import NODE_COLUMNS, NODE_ROWS, FloatArray, frozen
from engine.core.reference_proposal import ReferenceMoment
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
