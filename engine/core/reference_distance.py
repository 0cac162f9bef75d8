"""How far a reference lies from the first one of its fraction, which was confirmed before it.

Measured from the first, never from the last: so small steps add up.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from engine.core.breath import SignalChoice


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
            return f"at an unknown distance from the fraction's first ({self.unknown or 'not all of it was measured'})"
        levels = "".join(f", {one.choice.label} {one.level:+.2f} {one.choice.unit}" for one in self.corrected_levels)
        return (
            f"{self.distance_mm:.2f} mm from the fraction's first (shift {self.shift_mm:.1f} mm, height "
            f"{self.height_mm:+.1f} mm, turn {self.turn_deg:.1f} deg, tilt {self.tilt_deg:.1f} deg, shape "
            f"{self.shape_mm:.1f} mm{levels})"
        )
