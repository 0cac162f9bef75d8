"""Where the patient lies against the position of the plan, in six degrees of freedom, each with its uncertainty.

Axes are those of the patient's surface, named as IEC 61217 names them for a patient who lies head first on the back:
lateral to the patient's left, longitudinal to the head, vertical towards the camera; pitch, roll and yaw turn about
them in this order, right-handed. The couch's own axes are not known.

What a person checks of the camera before training: distance, tilt, coverage, light, time since it was opened.
"""

import math
from dataclasses import dataclass
from enum import StrEnum
from typing import NamedTuple

from engine.core.sentences import say, word

SHIFTS = ("lateral", "longitudinal", "vertical")
TURNS = ("pitch", "roll", "yaw")
CERTAINTY = 2.0
"""A degree of freedom is determined where this many standard uncertainties are at most the tolerance."""


class Degree(NamedTuple):
    """One degree of freedom: its name, value and standard uncertainty [mm of a shift, deg of a turn]."""

    name: str
    value: float
    uncertainty: float

    @property
    def is_shift(self) -> bool:
        """Whether it is a shift [mm]; a turn [deg] otherwise."""
        return self.name in SHIFTS

    @property
    def unit(self) -> str:
        """Unit of both numbers."""
        return "mm" if self.is_shift else "deg"


class PositionTolerance(NamedTuple):
    """Largest shift along each axis [mm], turn about each [deg], and remaining difference of shape [mm]."""

    shift_mm: float
    turn_deg: float
    shape_mm: float

    def of(self, degree: Degree) -> float:
        """Return the tolerance of a degree of freedom, in its unit."""
        return self.shift_mm if degree.is_shift else self.turn_deg

    def determines(self, degree: Degree) -> bool:
        """Whether a degree of freedom is known well enough to be compared with its tolerance."""
        return CERTAINTY * degree.uncertainty <= self.of(degree)  # NaN is not

    def holds(self, degree: Degree) -> bool:
        """Whether a degree of freedom is determined, and within its tolerance."""
        return self.determines(degree) and abs(degree.value) <= self.of(degree)

    def shortcomings(self, check: "PositionCheck") -> tuple[str, ...]:
        """Return what keeps a position from being within the tolerance, each as a part of a sentence; empty if none."""
        if check.unknown:
            return (say("it is not known ({unknown})", unknown=check.unknown),)
        found = [
            say("{name} {value:+.1f} {unit}", name=word(one.name), value=one.value, unit=one.unit)
            if self.determines(one)
            else say("{name} not determined", name=word(one.name))
            for one in check.degrees
            if not self.holds(one)
        ]
        if not check.shape_mm <= self.shape_mm:
            found.append(say("shape {shape_mm:.1f} mm", shape_mm=check.shape_mm))
        return tuple(found)


@dataclass(frozen=True, slots=True, kw_only=True)
class PositionCheck:
    """A comparison of the patient's surface with that of the plan's position, at the same moment of the breath.

    Attributes
    ----------
    shift_mm, turn_deg
        From the plan's position to the present one: along the axes [mm], of the region's middle, and about them [deg].
    shift_uncertainty_mm, turn_uncertainty_deg
        Standard uncertainty of each: the surface determines a slide along itself less well than a move out of itself.
    shape_mm
        Root mean square distance of the surfaces after the rigid motion [mm].
    unknown
        Why they cannot be compared; empty where they can.
    """

    shift_mm: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    turn_deg: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    shift_uncertainty_mm: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    turn_uncertainty_deg: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    shape_mm: float = math.nan
    unknown: str = ""

    @property
    def degrees(self) -> tuple[Degree, ...]:
        """The six degrees of freedom: shifts, then turns."""
        shifts = zip(SHIFTS, self.shift_mm, self.shift_uncertainty_mm, strict=True)
        turns = zip(TURNS, self.turn_deg, self.turn_uncertainty_deg, strict=True)
        return tuple(Degree(*one) for one in (*shifts, *turns))


class CameraAdvice(StrEnum):
    """What should be changed before training."""

    TOO_NEAR = "too_near"
    TOO_FAR = "too_far"
    TILTED = "tilted"
    GAPS = "gaps"
    TOO_DARK = "too_dark"
    TOO_BRIGHT = "too_bright"
    WARMING_UP = "warming_up"


@dataclass(frozen=True, slots=True, kw_only=True)
class CameraView:
    """The middle of one frame: the half of its width and height around the centre.

    Attributes
    ----------
    distance_mm
        Median depth; NaN without a reading.
    tilt_deg
        Angle between the optical axis and the normal of a plane through the readings; NaN with too few.
    coverage
        Share of the pixels with a reading.
    brightness, saturated
        Mean of the colour picture, 0 to 1, and the share of its pixels with a channel at its limit.
    running_s
        Time since the source was opened [s].
    warm_in_s
        How long the camera still has to run until it is warm [s]; 0 where it is, or is a recording.
    advice
        What lies outside of the recommended ranges.
    """

    distance_mm: float
    tilt_deg: float
    coverage: float
    brightness: float
    saturated: float
    running_s: float
    warm_in_s: float
    advice: tuple[CameraAdvice, ...]
