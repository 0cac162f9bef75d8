"""What a person checks of the camera before training: distance, tilt, coverage, light, time since it was opened."""

from dataclasses import dataclass
from enum import StrEnum


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
    advice
        What lies outside of the recommended ranges.
    """

    distance_mm: float
    tilt_deg: float
    coverage: float
    brightness: float
    saturated: float
    running_s: float
    advice: tuple[CameraAdvice, ...]
