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

    def to_arrow(self) -> "pa.Table":
        """Return the columns ``time_s`` and ``value_mm`` as an Arrow table, for pandas or polars."""
        import pyarrow as pa

        return pa.table({"time_s": self.time_s, "value_mm": self.value_mm})


def read_signal(path: str | Path, *, axis: str = "auto") -> Signal:
    """Read a breathing trace: an RPM ``.vxp``, a marker CSV, a QA text, or a CSV ``time_s,position_mm``.

    Parameters
    ----------
    axis
        Column of the position in a marker CSV or QA text: x, y, z, or auto, the one that moves.

    Raises
    ------
    RecordingError
        The file is damaged or of no known kind; names file, line and field.
    InvalidValueError
        ``axis`` is unknown.
    """
    from engine.core.errors import RecordingError
    from engine.core.files import open_plain
    from engine.qa.recorded_traces import read_trace
    from engine.qa.trace import COLUMNS, read_commanded

    path = Path(path)
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
