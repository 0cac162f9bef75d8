"""The numbers a gate decides by: the amplitude window and the limits of trust, each bounded where it is made.

Lengths are motion against the reference [mm], positive towards the camera. A session may be given tighter limits than a
site's, and nothing may change them while it runs: the values are frozen and the loop takes them once.
"""

import enum
import math
from dataclasses import dataclass

from engine.clock import NS_PER_MS
from engine.errors import InvalidValueError
from engine.frames import ROI_COLUMNS, ROI_ROWS, Motion

MAX_MOTION_MM = 200.0


class GateSignal(enum.StrEnum):
    """Which motion is gated on."""

    WHOLE = "whole"
    THORAX = "thorax"
    ABDOMEN = "abdomen"
    REGION = "region"


@dataclass(frozen=True, slots=True, kw_only=True)
class GateWindow:
    """The amplitude window.

    Attributes
    ----------
    signal
        Which motion is compared; a plain string of the same value is accepted.
    row, column
        Cell of the region grid, for ``region`` only.
    lower_mm, upper_mm
        The window; its edges belong to it.
    hysteresis_mm
        How far inside the edges the signal must be to *enter*; it leaves at the edges themselves, so hysteresis can
        only take beam-on time away.
    """

    signal: GateSignal | str = GateSignal.WHOLE
    row: int | None = None
    column: int | None = None
    lower_mm: float
    upper_mm: float
    hysteresis_mm: float = 0.0

    def __post_init__(self) -> None:
        """Refuse a window that is none."""
        if self.signal not in set(GateSignal):
            raise InvalidValueError("signal", self.signal, f"one of {', '.join(GateSignal)}")
        object.__setattr__(self, "signal", GateSignal(self.signal))
        self._check_cell("row", self.row, ROI_ROWS)
        self._check_cell("column", self.column, ROI_COLUMNS)
        _check_number("lower_mm", self.lower_mm, -MAX_MOTION_MM, MAX_MOTION_MM)
        _check_number("upper_mm", self.upper_mm, -MAX_MOTION_MM, MAX_MOTION_MM)
        _check_number("hysteresis_mm", self.hysteresis_mm, 0.0, MAX_MOTION_MM)
        if not self.lower_mm < self.upper_mm:
            raise InvalidValueError("upper_mm", self.upper_mm, f"more than lower_mm ({self.lower_mm:g})")
        half_width_mm = 0.5 * (self.upper_mm - self.lower_mm)
        if not self.hysteresis_mm < half_width_mm:
            bound = f"less than half the window's width ({half_width_mm:g})"
            raise InvalidValueError("hysteresis_mm", self.hysteresis_mm, bound)

    def signal_mm(self, motion: Motion) -> float:
        """Pick the gated motion [mm]; NaN where the region grid has no such cell."""
        if self.signal is not GateSignal.REGION:
            return float(getattr(motion, f"{self.signal}_mm"))
        row, column = self.row, self.column
        rows, columns = motion.regions_mm.shape
        if row is None or column is None or row >= rows or column >= columns:
            return math.nan
        return float(motion.regions_mm[row, column])

    def contains(self, signal_mm: float, *, was_inside: bool) -> bool:
        """Whether the signal is inside; NaN never is."""
        margin_mm = 0.0 if was_inside else self.hysteresis_mm
        return self.lower_mm + margin_mm <= signal_mm <= self.upper_mm - margin_mm

    def _check_cell(self, name: str, value: int | None, size: int) -> None:
        if self.signal is not GateSignal.REGION:
            if value is not None:
                raise InvalidValueError(name, value, "absent unless signal is region")
        elif isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < size:
            raise InvalidValueError(name, value, f"a whole number from 0 to {size - 1}")


@dataclass(frozen=True, slots=True, kw_only=True)
class GateLimits:
    """How far the gate trusts what it sees. The defaults are for 30 frames a second.

    Attributes
    ----------
    dwell_ms
        How long every frame must have been good and inside before the beam may be on, by the host's clock and by the
        device's.
    min_good_frames
        How many such frames in a row; at least two, so that no single frame turns a beam on.
    lease_ms
        How long after a frame was *received* the line may stay on without a newer one.
    max_frame_age_ms
        Oldest a frame may be when it is decided on.
    max_gap_ms
        Longest step from frame to frame, by the device's and by the host's clock; a frame is missing beyond it.
    max_lag_ms
        How much later than the promptest frame so far a frame may come (host time minus device time): a backlog in a
        driver looks fresh by its arrival and is not.
    max_silence_ms
        Silence, or an age, that is no hiccup: the gate faults.
    watchdog_ms
        Longest time between two decisions of an armed engine before the watchdog holds and latches. More than the
        lease, which takes the beam off by itself: a hiccup should cost a dwell, not a person's acknowledgement.
    min_valid_share
        Least share of the region the sensor must see, 0 to 1.
    min_inlier_share
        Least share of what the sensor saw that the motion model must explain, 0 to 1.
    max_residual_mm
        Largest mean misfit of any cell of the region that the motion model may leave.
    max_jump_mm
        Largest step of the signal from one frame to the next.
    is_played
        The frames come from a recording. A player that falls behind plays late, and then its lag says nothing about
        the age of a frame; the loop sets this from what the source says of itself, whatever was given.
    """

    window: GateWindow
    dwell_ms: float = 100.0
    min_good_frames: int = 3
    lease_ms: float = 80.0
    max_frame_age_ms: float = 60.0
    max_gap_ms: float = 60.0
    max_lag_ms: float = 100.0
    max_silence_ms: float = 500.0
    watchdog_ms: float = 200.0
    min_valid_share: float = 0.8
    min_inlier_share: float = 0.6
    max_residual_mm: float = 3.0
    max_jump_mm: float = 4.0
    is_played: bool = False

    def __post_init__(self) -> None:
        """Refuse every number out of its bound."""
        for name, (low, high) in LIMIT_BOUNDS.items():
            _check_number(name, getattr(self, name), low, high)
        if not isinstance(self.min_good_frames, int):
            raise InvalidValueError("min_good_frames", self.min_good_frames, "a whole number")
        if self.max_silence_ms < self.max_gap_ms:
            bound = f"at least max_gap_ms ({self.max_gap_ms:g})"
            raise InvalidValueError("max_silence_ms", self.max_silence_ms, bound)


LIMIT_BOUNDS: dict[str, tuple[float, float]] = {
    "dwell_ms": (0.0, 10_000.0),
    "min_good_frames": (2, 300),
    "lease_ms": (20.0, 200.0),
    "max_frame_age_ms": (5.0, 200.0),
    "max_gap_ms": (10.0, 200.0),
    "max_lag_ms": (20.0, 500.0),
    "max_silence_ms": (50.0, 2_000.0),
    "watchdog_ms": (40.0, 500.0),
    "min_valid_share": (0.1, 1.0),
    "min_inlier_share": (0.1, 1.0),
    "max_residual_mm": (0.1, 20.0),
    "max_jump_mm": (0.1, 20.0),
}
"""Lowest and highest value each limit may take; a site can only choose within."""


def ns_from_ms(duration_ms: float) -> int:
    """Convert to whole nanoseconds, rounded down."""
    return int(duration_ms * NS_PER_MS)


def _check_number(name: str, value: object, low: float, high: float) -> None:
    # Written so that NaN fails: every comparison with it is false.
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise InvalidValueError(name, value, f"a number from {low:g} to {high:g}")
