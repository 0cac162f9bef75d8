"""Two models of the same sensor, with different errors, so that a method is not tuned to one of them.

``usual`` is fitted to three real recordings. ``locking`` has the noise of two others, which is correlated over a longer
distance, and *pixel locking*: the matching of structured light prefers certain sub-pixel positions, which differ from
place to place. This error is fixed to the pixel. Its period is one pixel of disparity, 8 steps; the matching window
makes it smooth over 9 px. Over the depth range of a breath it is a wrong local gain, the same in every breath.
"""

from dataclasses import dataclass, field

from engine.core.errors import InvalidValueError

STEPS_A_PX = 8
"""Steps of the sensor in one pixel of disparity."""

WINDOW_PX = 9
"""Side of the matching window."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SensorModel:
    """Errors of a sensor in shifts, its own unit.

    Attributes
    ----------
    noise_shifts
        Standard deviation of the temporal noise, before rounding.
    noise_parts
        Share of its variance and blur [px] of each part of the noise; a blur of 0 is white.
    pattern_shifts, pattern_blur_px
        The constant error of each pixel.
    locking_shifts
        Root mean square over the pixels of the amplitude of the error that varies with the sub-pixel phase.
    """

    noise_shifts: float
    noise_parts: tuple[tuple[float, float], ...]
    pattern_shifts: float
    pattern_blur_px: float
    locking_shifts: float = field(default=0.0)


SENSORS = {
    "usual": SensorModel(
        noise_shifts=0.34,
        noise_parts=((0.22, 0.0), (0.43, 1.1), (0.35, 2.1)),
        pattern_shifts=0.2,
        pattern_blur_px=3.0,
    ),
    # 0.35 mm at 0.85 m, where a step is 2.1 mm, and a constant part of the same size.
    "locking": SensorModel(
        noise_shifts=0.364,
        noise_parts=((0.331, 0.0), (0.459, 2.1), (0.195, 3.0), (0.015, 6.0)),
        pattern_shifts=0.166,
        pattern_blur_px=3.0,
        locking_shifts=0.166,
    ),
}
"""Sensor models by name."""

USUAL = "usual"


def find_sensor(name: str) -> SensorModel:
    """Return the sensor model of this name; raise InvalidValueError for any other."""
    if name not in SENSORS:
        raise InvalidValueError("sensor", name, "one of " + ", ".join(SENSORS))
    return SENSORS[name]
