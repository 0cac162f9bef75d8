"""Reads recorded breathing to drive a volunteer: marker CSV, RPM ``.vxp``, and QA target motion.

Each reader is strict: an invalid value is a RecordingError that names file, line and field. Only these known
peculiarities of the formats are accepted:

* marker CSV (``Frame;Timestamp;x;y;z``, decimal comma, ms): the last one or two lines may be summaries, and the times
  of a few interpolated samples are wrong (their frame number is right). The axis is z unless that one hardly moves; see
  :func:`read_trace`.
* RPM ``.vxp``: mm = value x Scale_factor, and the raw value *falls* on inhale; time in ms, not from 0; a negative first
  flag bit pattern of -1 means lost (dropped, and bridged), -2 not periodic (kept).
* QA text (``t x y z rx ry rz`` in s, mm, deg): z is anterior-posterior.
"""

import math
import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.interpolate import PchipInterpolator

from engine.core.errors import InvalidValueError, RecordingError
from engine.core.files import open_plain
from engine.core.frames import FloatArray

Grid = npt.NDArray[np.float64]
MAX_BYTES = 16 * 1024 * 1024
MIN_SAMPLES = 10
MAX_GAP_S = 5.0
MAX_RANGE_MM = 80.0
MAX_SCALE = 1000.0
SUMMARY_LINES = 2
STAMP_TOLERANCE_S = 0.06
STILL_SHARE = 0.15
FLAG_LOST = -1
AXES = ("x", "y", "z")
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)([eE][+-]?\d{1,3})?")


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trace:
    """Recorded motion: ``motion_mm`` at ``time_s`` (from 0, increasing), inhale positive, about 0 at the end of exhale.

    ``kind`` is "markers", "rpm" or "qa"; ``axis`` the column it was taken from; ``restored`` counts samples whose time
    was taken from their frame number. An RPM file may name its patient and say where the beam was on (``ttlout``).
    """

    kind: str
    axis: str
    time_s: Grid
    motion_mm: Grid
    restored: int = 0
    patient_id: str = ""
    is_on: npt.NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))

    @property
    def seconds(self) -> float:
        """Length [s]."""
        return float(self.time_s[-1])

    def at(self, time_s: FloatArray) -> Grid:
        """Read the motion at any time [mm] without overshoot; constant before its beginning and after its end."""
        clipped = np.clip(time_s, 0.0, self.time_s[-1])
        return np.asarray(PchipInterpolator(self.time_s, self.motion_mm)(clipped))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Line:
    """One line of a file, and where it stands, for the message."""

    name: str
    number: int
    fields: tuple[str, ...]

    def value(self, column: int, field: str, *, decimal_comma: bool = False) -> float:
        """Parse one number; raise RecordingError naming the field and the bound."""
        text = self.fields[column].strip()
        plain = text.replace(",", ".", 1) if decimal_comma else text
        if not _NUMBER.fullmatch(plain) or (decimal_comma and "." in text):
            raise self.refuse(field, text, "a number" + (" with a decimal comma" if decimal_comma else ""))
        value = float(plain)
        if not math.isfinite(value):
            raise self.refuse(field, text, "a finite number")
        return value

    def refuse(self, field: str, shown: str, bound: str) -> RecordingError:
        """Return an error that names file, line, field, value and bound."""
        return RecordingError(f"{self.name}: line {self.number}: {field} is {shown[:40]!r}: must be {bound}")


def read_trace(path: Path, *, axis: str = "auto") -> Trace:
    """Read a trace of any known kind; the content determines the kind, not the name.

    Parameters
    ----------
    path
        The file.
    axis
        Column of position: "x", "y", "z", or "auto", which is z unless another moves over six times as far (some
        marker sessions are rotated). An RPM file has only one.

    Raises
    ------
    RecordingError
        The file is of no known kind or damaged; names file, line and field.
    InvalidValueError
        ``axis`` is unknown.
    """
    if axis not in (*AXES, "auto"):
        raise InvalidValueError("axis", axis, "x, y, z or auto")
    name, lines = _read_lines(path)
    if not lines:
        raise RecordingError(f"{name}: is empty: must be a marker CSV, an RPM .vxp or a QA text")
    first = lines[0].strip().lower()
    if first == "[header]":
        return _read_rpm(name, lines)
    if first.replace('"', "").replace(" ", "") == "frame;timestamp;x;y;z":
        return _read_markers(name, lines, axis)
    if _NUMBER.fullmatch((first.split() or [""])[0]):
        return _read_qa(name, lines, axis)
    raise RecordingError(f"{name}: line 1 is {lines[0][:40]!r}: must begin a marker CSV, an RPM .vxp or a QA text")


def _read_lines(path: Path) -> tuple[str, list[str]]:
    try:
        with open_plain(path) as file:
            content = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:  # a name with a NUL is a ValueError
        raise RecordingError(f"{path.name}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if len(content) > MAX_BYTES:
        raise RecordingError(f"{path.name}: is larger than {MAX_BYTES} bytes: too long for a breathing trace")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path.name}: is not UTF-8 text (byte {error.start})") from error
    # Blank lines are accepted at the end only.
    return path.name, text.replace("\r\n", "\n").rstrip().split("\n") if text.strip() else []


def _split(name: str, lines: list[str], first: int, separator: str | None, columns: int) -> list[_Line]:
    """Cut lines from number ``first`` (from 0) into fields."""
    split = []
    for number, text in enumerate(lines[first:], start=first + 1):
        fields = tuple(text.split(separator))
        if len(fields) != columns:
            raise RecordingError(f"{name}: line {number}: has {len(fields)} fields: must have {columns}")
        split.append(_Line(name=name, number=number, fields=fields))
    return split


def _read_markers(name: str, lines: list[str], axis: str) -> Trace:
    rows = _split(name, lines, 1, ";", 5)
    fields = ("Frame", "Timestamp", *AXES)
    table = [[row.value(i, field, decimal_comma=True) for i, field in enumerate(fields)] for row in rows]
    kept = len(rows)
    # Summaries at the end: frame number or time goes back there. Anywhere else that is a damaged file.
    for back in range(min(SUMMARY_LINES, len(rows) - 1), 0, -1):
        if table[-back][0] <= table[-back - 1][0] or table[-back][1] <= table[-back - 1][1]:
            kept = len(rows) - back
            break
    rows, values = rows[:kept], np.array(table[:kept]).reshape(-1, 5)
    _check_increasing(rows, values[:, 0].tolist(), "Frame")
    times, restored = _restore_times(rows, values[:, 0], values[:, 1] / 1000.0)
    _check_increasing(rows, times.tolist(), "Timestamp")
    return _trace(name, "markers", times, *_pick(values[:, 2:], axis), restored=restored)


def _restore_times(rows: list[_Line], frames: Grid, times_s: Grid) -> tuple[Grid, int]:
    """Replace wrong time stamps by times from the frame number; interpolated samples hold the sum of two neighbours'.

    Returns the times [s] and the number of restored ones.
    """
    if len(rows) < MIN_SAMPLES:
        return times_s, 0
    period = float(np.median(np.diff(times_s) / np.diff(frames)))
    expected = period * frames + float(np.median(times_s - period * frames))
    is_off = np.abs(times_s - expected) > STAMP_TOLERANCE_S
    restored = int(np.count_nonzero(is_off))
    if restored > max(3, 0.01 * len(rows)):
        first = int(np.flatnonzero(is_off)[0])
        raise rows[first].refuse("Timestamp", f"{1000 * times_s[first]:g}", f"near {1000 * expected[first]:.0f} ms")
    return np.where(is_off, expected, times_s), restored


def _read_qa(name: str, lines: list[str], axis: str) -> Trace:
    rows = _split(name, lines, 0, None, 7)
    fields = ("t", *AXES, "rx", "ry", "rz")
    table = np.array([[row.value(i, field) for i, field in enumerate(fields)] for row in rows]).reshape(-1, 7)
    _check_increasing(rows, table[:, 0].tolist(), "t")
    return _trace(name, "qa", table[:, 0], *_pick(table[:, 1:4], "z" if axis == "auto" else axis))


def _read_rpm(name: str, lines: list[str]) -> Trace:
    values, first = _read_rpm_keys(name, lines)
    layout, scale = _read_rpm_header(name, values)
    rows = _split(name, lines, first, ",", len(layout))
    at = {field: layout.index(field) for field in ("amplitude", "timestamp", "validflag")}
    table = np.array([[row.value(column, field) for field, column in at.items()] for row in rows]).reshape(-1, 3)
    _check_increasing(rows, table[:, 1].tolist(), "timestamp")
    seen = table[:, 2] != FLAG_LOST
    found = _trace(name, "rpm", table[seen, 1] / 1000.0, -scale * table[seen, 0], "amplitude")
    out = layout.index("ttlout") if "ttlout" in layout else None
    is_on = np.array([out is not None and row.fields[out].strip() == "1" for row in rows], dtype=bool)
    patient = values["patient_id"].fields[0] if "patient_id" in values else ""
    return replace(found, patient_id=patient, is_on=is_on[seen])


def _read_rpm_header(name: str, values: dict[str, _Line]) -> tuple[list[str], float]:
    """Return the columns and the scale [mm]."""
    for key in ("data_layout", "scale_factor"):
        if key not in values:
            raise RecordingError(f"{name}: [Header] has no {key}")
    layout = [field.strip().lower() for field in values["data_layout"].fields[0].split(",")]
    for column in ("amplitude", "timestamp", "validflag"):
        if layout.count(column) != 1:
            raise values["data_layout"].refuse("Data_layout", ",".join(layout), f"a list with one {column}")
    scale = values["scale_factor"].value(0, "Scale_factor")
    if not 0.0 < scale <= MAX_SCALE:
        raise values["scale_factor"].refuse("Scale_factor", f"{scale:g}", f"over 0 and at most {MAX_SCALE:g}")
    return layout, scale


def _read_rpm_keys(name: str, lines: list[str]) -> tuple[dict[str, _Line], int]:
    values: dict[str, _Line] = {}
    for number, text in enumerate(lines[1:], start=2):
        if text.strip().lower() == "[data]":
            return values, number
        key, equals, value = text.partition("=")
        if not equals:
            raise RecordingError(f"{name}: line {number}: is {text[:40]!r}: must be key=value or [Data]")
        values[key.strip().lower()] = _Line(name=name, number=number, fields=(value.strip(),))
    raise RecordingError(f"{name}: has no [Data]")


def _check_increasing(rows: list[_Line], times: list[float], field: str) -> None:
    for row, before, after in zip(rows[1:], times, times[1:], strict=False):
        if after <= before:
            raise row.refuse(field, f"{after:g}", f"later than {before:g}, the line before")


def _pick(position_mm: Grid, axis: str) -> tuple[Grid, str]:
    if axis == "auto" and len(position_mm):
        reach = np.ptp(np.percentile(position_mm, (5.0, 95.0), axis=0), axis=0)
        axis = "z" if reach[2] >= STILL_SHARE * reach.max() else AXES[int(reach.argmax())]
    axis = "z" if axis == "auto" else axis
    return position_mm[:, AXES.index(axis)], axis


def _trace(name: str, kind: str, time_s: Grid, position_mm: Grid, axis: str, *, restored: int = 0) -> Trace:
    if len(time_s) < MIN_SAMPLES:
        raise RecordingError(f"{name}: has {len(time_s)} samples: must have at least {MIN_SAMPLES}")
    gap = float(np.diff(time_s).max())
    if gap > MAX_GAP_S:
        raise RecordingError(f"{name}: has a gap of {gap:.1f} s: must be at most {MAX_GAP_S:g} s")
    reach = float(np.ptp(position_mm))
    if reach > MAX_RANGE_MM:
        raise RecordingError(f"{name}: {axis} moves by {reach:.0f} mm: must be at most {MAX_RANGE_MM:g} mm")
    rest = float(np.percentile(position_mm, 10.0))
    return Trace(kind=kind, axis=axis, time_s=time_s - time_s[0], motion_mm=position_mm - rest, restored=restored)
