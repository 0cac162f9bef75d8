"""A signal: values over time, of a region or of another instrument."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from engine.core.errors import InvalidValueError

if TYPE_CHECKING:
    import pyarrow as pa

Values = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Signal:
    """Motion over time.

    Attributes
    ----------
    name
        What moves.
    time_s
        Increasing times [s], shape (n,), at least two.
    value_mm
        Motion [mm], inhale positive, shape (n,); NaN where it was not measured.
    """

    name: str = "signal"
    time_s: Values
    value_mm: Values

    def __post_init__(self) -> None:
        """Check shapes and times once."""
        object.__setattr__(self, "time_s", np.asarray(self.time_s, dtype=np.float64))
        object.__setattr__(self, "value_mm", np.asarray(self.value_mm, dtype=np.float64))
        if self.time_s.ndim != 1 or len(self.time_s) < 2:
            raise InvalidValueError("time_s", str(self.time_s.shape), "of shape (n,), at least two")
        if self.value_mm.shape != self.time_s.shape:
            raise InvalidValueError("value_mm", str(self.value_mm.shape), f"of the shape of time_s {self.time_s.shape}")
        if not np.all(np.diff(self.time_s) > 0.0):  # false for NaN, too
            raise InvalidValueError("time_s", "not increasing", "finite and increasing")

    @property
    def peak_to_peak_mm(self) -> float:
        """Range of the known values [mm]: what a wrong column or unit shows at once; NaN where none is known."""
        known = self.value_mm[np.isfinite(self.value_mm)]
        return float(np.ptp(known)) if len(known) else float("nan")

    def to_arrow(self) -> "pa.Table":
        """Return the columns ``time_s`` and ``value_mm`` as an Arrow table, for pandas or polars."""
        import pyarrow as pa

        return pa.table({"time_s": self.time_s, "value_mm": self.value_mm})


MM_OF = {"mm": 1.0, "cm": 10.0, "m": 1000.0}
S_OF = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
MOST_BYTES = 64 * 1024 * 1024


def read_signal(
    path: str | Path,
    *,
    axis: str = "auto",
    value: str | None = None,
    unit: str = "mm",
    time: str = "time_s",
    time_unit: str = "s",
    is_inverted: bool = False,
) -> Signal:
    """Read a breathing trace: an RPM ``.vxp``, a marker CSV, a QA text, or a CSV with named columns.

    Look at `Signal.peak_to_peak_mm` before the signal is used: a breath is some millimetres to some centimetres.

    Parameters
    ----------
    axis
        Column of the position in a marker CSV or QA text: x, y, z, or auto, the one that moves.
    value, unit, time, time_unit
        Of another CSV, with a line of names: the column of the values and its unit (mm, cm, m), that of the times and
        its unit (s, ms, us). Columns are separated by commas, semicolons (then with decimal commas) or tabs. An empty
        value is NaN. Without ``value`` the file is one of the other kinds, or a CSV ``time_s,position_mm``.
    is_inverted
        Whether the values fall on inhale. A ``.vxp`` is turned round already.

    Raises
    ------
    RecordingError
        The file is damaged or of no known kind; names file, line and field.
    InvalidValueError
        ``axis``, a unit or a column is unknown.
    """
    found = _read_known(Path(path), axis) if value is None else _read_columns(Path(path), value, unit, time, time_unit)
    if not is_inverted:
        return found
    return Signal(name=found.name, time_s=found.time_s, value_mm=-found.value_mm)


def _read_columns(path: Path, value: str, unit: str, time: str, time_unit: str) -> Signal:
    import csv

    from engine.core.errors import RecordingError

    for field, given, known in (("unit", unit, MM_OF), ("time_unit", time_unit, S_OF)):
        if given not in known:
            raise InvalidValueError(field, given, ", ".join(known))
    lines = _lines(path)
    separator = max(",;\t", key=lines[0].count)
    rows = csv.DictReader(lines, delimiter=separator)
    rows.fieldnames = [name.strip() for name in rows.fieldnames or ()]
    for field, column in (("value", value), ("time", time)):
        if rows.fieldnames.count(column) != 1:
            raise InvalidValueError(field, column, f"one of the columns {', '.join(rows.fieldnames)}"[:300])
    found = []
    for row in rows:
        at, mm = (
            (row[column] or "").replace(",", "." if separator == ";" else ",").strip() for column in (time, value)
        )
        try:
            found.append((float(at), float(mm or "nan")))
        except ValueError as error:
            line = f"{path.name}: line {rows.line_num}: {time}, {value} are {at[:40]!r}, {mm[:40]!r}"
            raise RecordingError(f"{line}: must be numbers") from error
    if len(found) < 2:
        raise RecordingError(f"{path.name}: has {len(found)} values: must have at least two")
    times, values = np.array(found).T
    return Signal(name=value, time_s=(times - times[0]) * S_OF[time_unit], value_mm=values * MM_OF[unit])


def _lines(path: Path) -> list[str]:
    from engine.core.errors import RecordingError
    from engine.core.files import open_plain

    try:
        with open_plain(path) as file:
            content = file.read(MOST_BYTES + 1)
        lines = content.decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise RecordingError(f"{path.name}: cannot be read ({getattr(error, 'strerror', None) or error})") from error
    if len(content) > MOST_BYTES or not lines:
        raise RecordingError(f"{path.name}: must have 1 to {MOST_BYTES} bytes")
    return lines


def _read_known(path: Path, axis: str) -> Signal:
    from engine.core.errors import RecordingError
    from engine.core.files import open_plain
    from engine.qa.recorded_traces import read_trace
    from engine.qa.trace import COLUMNS, read_commanded

    try:
        with open_plain(path) as file:
            is_plain = file.read(64).lstrip(b"\xef\xbb\xbf \t").startswith(COLUMNS[0].encode())
    except OSError as error:
        raise RecordingError(f"{path.name}: cannot be read ({error.strerror or error})") from error
    if is_plain:
        commanded = read_commanded(path)
        return Signal(name=path.stem, time_s=commanded.time_s, value_mm=commanded.position_mm)
    trace = read_trace(path, axis=axis)
    return Signal(name=path.stem, time_s=trace.time_s, value_mm=trace.motion_mm)
