"""Commanded motion of a QA phantom: positions [mm] over time [s], read from a CSV or a robot's file.

Positive is towards the camera (anterior), the sign of ``motion_mm`` everywhere.
"""

import csv
import io
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from engine.core.errors import InvalidValueError, RecordingError
from engine.core.files import open_plain
from engine.core.frames import FloatArray, frozen

if TYPE_CHECKING:  # loaded with the first trace: the service's schemas read this module's bounds
    from scipy.interpolate import CubicSpline

Grid = npt.NDArray[np.float64]
COLUMNS = ["time_s", "position_mm"]
MAX_BYTES = 8 * 1024 * 1024
FEWEST, MOST = 10, 200_000
MAX_GAP_S = 1.0
MAX_SECONDS = 3600.0
MAX_POSITION_MM = 100.0
MIN_REACH_MM = 0.5
RISEN_SHARE = 0.1


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class CommandedTrace:
    """Positions [mm] at increasing times [s], each of shape (n,)."""

    time_s: Grid
    position_mm: Grid
    _smooth: "CubicSpline" = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Check length, order, gaps and reach of the samples; raise InvalidValueError."""
        from scipy.interpolate import CubicSpline

        _check_samples(self.time_s, self.position_mm)
        frozen(self.time_s)
        frozen(self.position_mm)
        object.__setattr__(self, "_smooth", CubicSpline(self.time_s, self.position_mm, extrapolate=False))

    @property
    def span_s(self) -> tuple[float, float]:
        """Times of the first and the last sample [s]."""
        return float(self.time_s[0]), float(self.time_s[-1])

    @property
    def reach_mm(self) -> tuple[float, float]:
        """Lowest and highest position [mm]."""
        return float(self.position_mm.min()), float(self.position_mm.max())

    def at(self, time_s: FloatArray) -> Grid:
        """Interpolate the position at times [s] with a cubic spline [mm], same shape; NaN outside of `span_s`."""
        return np.asarray(self._smooth(np.asarray(time_s, dtype=np.float64)))

    def ends_of_exhale_mm(self, before_s: float, count: int) -> float:
        """Return the mean of the last ``count`` low positions before a time [mm]; NaN where there are fewer.

        A low position is the lowest one of each way below the middle of the positions so far, if the trace has risen
        from it by a tenth of its reach since.
        """
        so_far = self.position_mm[self.time_s < before_s]
        if so_far.size == 0:
            return math.nan
        is_low = so_far < (so_far.min() + so_far.max()) / 2.0
        begins = np.flatnonzero(np.diff(is_low.astype(np.int8), prepend=0) == 1)
        ends = [*(np.flatnonzero(np.diff(is_low.astype(np.int8)) == -1) + 1).tolist(), len(so_far)]
        ways = [so_far[begin:end] for begin, end in zip(begins.tolist(), ends, strict=False)]
        risen_mm = RISEN_SHARE * (so_far.max() - so_far.min())
        lows = [float(way.min()) for way in ways if way[int(way.argmin()) :].max() - way.min() >= risen_mm]
        return float(np.mean(lows[-count:])) if len(lows) >= count else math.nan


def read_commanded(path: Path) -> CommandedTrace:
    """Read a trace: CSV with the columns ``time_s,position_mm``, or a robot's file (``t x y z rx ry rz``, of which z).

    Raises
    ------
    RecordingError
        The file cannot be read or parsed; names file, line and field.
    InvalidValueError
        The samples are too few, out of order, have gaps or move too little or too highest_mm.
    """
    try:
        with open_plain(path) as file:
            content = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:  # a name with a NUL is a ValueError
        raise RecordingError(f"{path.name}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if len(content) > MAX_BYTES:
        raise RecordingError(f"{path.name}: is larger than {MAX_BYTES} bytes: too long for a trace")
    try:
        text = content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path.name}: is not UTF-8 text (byte {error.start})") from error
    if text.lstrip().startswith(COLUMNS[0]):
        return _parse(path.name, text)
    from engine.qa.recorded_traces import read_trace

    robot = read_trace(path, axis="z")
    if robot.kind != "qa":
        raise RecordingError(
            f"{path.name}: is a recording of kind {robot.kind}: must be {','.join(COLUMNS)} or a robot's file"
        )
    return CommandedTrace(time_s=robot.time_s, position_mm=robot.motion_mm)


def _parse(name: str, text: str) -> CommandedTrace:
    rows = list(csv.reader(io.StringIO(text.rstrip())))
    if rows[0] != COLUMNS:
        raise RecordingError(f"{name}: line 1: is {','.join(rows[0])[:40]!r}: must be {','.join(COLUMNS)}")
    values = [_numbers(name, number, row) for number, row in enumerate(rows[1:], start=2)]
    time_s, position_mm = np.array(values).reshape(-1, 2).T.copy()
    return CommandedTrace(time_s=time_s, position_mm=position_mm)


def _numbers(name: str, number: int, row: list[str]) -> tuple[float, float]:
    if len(row) != len(COLUMNS):
        raise RecordingError(f"{name}: line {number}: has {len(row)} fields: must have {len(COLUMNS)}")
    return _number(name, number, COLUMNS[0], row[0]), _number(name, number, COLUMNS[1], row[1])


def _number(name: str, number: int, field: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise RecordingError(f"{name}: line {number}: {field} is {text[:40]!r}: must be a finite number")
    return value


def _check_samples(time_s: Grid, position_mm: Grid) -> None:
    if not FEWEST <= len(time_s) <= MOST or len(time_s) != len(position_mm):
        raise InvalidValueError("trace", f"{len(time_s)} samples", f"{FEWEST} to {MOST} samples of time and position")
    if not (np.isfinite(time_s).all() and np.isfinite(position_mm).all()):
        raise InvalidValueError("trace", "not finite", "finite numbers")
    steps = np.diff(time_s)
    worst = int(np.argmin(steps))
    if steps[worst] <= 0.0:
        raise InvalidValueError(
            "trace.time_s", float(time_s[worst + 1]), f"later than the previous sample's {time_s[worst]:g}"
        )
    if steps.max() > MAX_GAP_S:
        raise InvalidValueError("trace.time_s", f"a gap of {steps.max():.2f} s", f"gaps of at most {MAX_GAP_S:g} s")
    if abs(time_s[0]) > MAX_SECONDS or time_s[-1] - time_s[0] > MAX_SECONDS:
        raise InvalidValueError("trace.time_s", f"{time_s[0]:g} to {time_s[-1]:g}", f"at most {MAX_SECONDS:g} s long")
    highest_mm = float(np.abs(position_mm).max())
    if highest_mm > MAX_POSITION_MM:
        raise InvalidValueError("trace.position_mm", highest_mm, f"at most {MAX_POSITION_MM:g} mm from 0")
    if np.ptp(position_mm) < MIN_REACH_MM:
        raise InvalidValueError(
            "trace.position_mm", float(np.ptp(position_mm)), f"moving by {MIN_REACH_MM:g} mm at least"
        )
