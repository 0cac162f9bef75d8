"""Strict reader of a spirometer's text file with two columns: time, and flow or volume.

The header names them: ``time_s`` or ``time_ms``, and ``flow_l_per_s`` or ``volume_l``, in either order. Columns are
separated by commas or semicolons; with semicolons a decimal comma is accepted. Gaps in time, repeated times and
implausible flows are refused with line and column.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from engine.core.errors import InvalidValueError
from engine.core.files import open_plain
from engine.core.frames import FloatArray, frozen

MAX_BYTES = 64 * 1024 * 1024
MIN_SAMPLES = 20
MIN_STEP_S, MAX_STEP_S = 1e-4, 1.0
LONGEST_S = 86_400.0
_SECONDS = {"time_s": 1.0, "time_ms": 1e-3}
_BOUNDS = {"flow_l_per_s": 20.0, "volume_l": 100.0}


class FlowFileError(InvalidValueError):
    """A spirometer's file is invalid; names line and column, value and bound."""

    code = "flow_file_invalid"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Spirometry:
    """A spirometer's recording.

    Attributes
    ----------
    time_s
        Time on the spirometer's clock [s], increasing, shape (n,).
    values
        Flow [l/s] or volume [l], shape (n,).
    is_flow
        Whether ``values`` are flow.
    """

    time_s: FloatArray
    values: FloatArray
    is_flow: bool

    def __post_init__(self) -> None:
        """Make both arrays read-only."""
        frozen(self.time_s)
        frozen(self.values)


def read_flow(path: Path) -> Spirometry:
    """Read a spirometer's file; raise FlowFileError if it is invalid."""
    lines = _lines(path)
    separator = ";" if ";" in lines[0] else ","
    names = [name.strip().strip('"').lower() for name in lines[0].split(separator)]
    time, value = _columns(names)
    table = [
        _numbers(line, names, separator, f"{path.name} line {number}")
        for number, line in enumerate(lines[1:], start=2)
        if line.strip()
    ]
    if len(table) < MIN_SAMPLES:
        raise FlowFileError(path.name, f"{len(table)} samples", f"{MIN_SAMPLES} samples or more")
    numbers = np.array(table)
    time_s = numbers[:, time] * _SECONDS[names[time]]
    _check_times(path, time_s, names[time], [number for number, line in enumerate(lines) if line.strip()][1:])
    return Spirometry(time_s=time_s, values=numbers[:, value].copy(), is_flow=names[value] == "flow_l_per_s")


def _lines(path: Path) -> list[str]:
    try:
        with open_plain(path) as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise FlowFileError("file", str(path), f"readable ({error.strerror})") from error
    if len(content) > MAX_BYTES:
        raise FlowFileError(path.name, f"{len(content)} bytes or more", f"at most {MAX_BYTES} bytes")
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise FlowFileError(path.name, f"{len(content)} bytes", f"text in UTF-8 ({error.reason})") from error
    lines = text.splitlines()
    if not lines or not lines[0].strip():
        raise FlowFileError(f"{path.name} line 1", "", "a header, for example time_s,flow_l_per_s")
    return lines


def _columns(names: list[str]) -> tuple[int, int]:
    """Return the indices of the time column and of the flow or volume column."""
    times = [index for index, name in enumerate(names) if name in _SECONDS]
    values = [index for index, name in enumerate(names) if name in _BOUNDS]
    if len(names) != 2 or len(times) != 1 or len(values) != 1:
        bound = f"two columns: {' or '.join(_SECONDS)}, and {' or '.join(_BOUNDS)}"
        raise FlowFileError("line 1", ", ".join(names)[:60], bound)
    return times[0], values[0]


def _numbers(line: str, names: list[str], separator: str, where: str) -> list[float]:
    cells = line.split(separator)
    if len(cells) != len(names):
        raise FlowFileError(where, line[:60], f"{len(names)} columns")
    numbers = []
    for name, cell in zip(names, cells, strict=True):
        text = cell.strip().strip('"')
        bound = _BOUNDS.get(name, 1e12)
        try:
            # Python parses 1_0 as ten; refuse it.
            number = float(text.replace("_", "x").replace(",", "." if separator == ";" else ","))
        except ValueError as error:
            raise FlowFileError(f"{where}, {name}", text[:40], "a number") from error
        if not -bound <= number <= bound:
            raise FlowFileError(f"{where}, {name}", number, f"from {-bound:g} to {bound:g}")
        numbers.append(number)
    return numbers


def _check_times(path: Path, time_s: FloatArray, name: str, line_index: list[int]) -> None:
    steps = np.diff(time_s)
    wrong = np.flatnonzero(~((steps >= MIN_STEP_S) & (steps <= MAX_STEP_S)))
    if wrong.size:
        at = int(wrong[0]) + 1
        where = f"{path.name} line {line_index[at] + 1}, {name}"
        bound = f"later than the line before, by {MIN_STEP_S:g} to {MAX_STEP_S:g} s"
        raise FlowFileError(where, f"{steps[at - 1]:g} s after the line before", bound)
    if time_s[-1] - time_s[0] > LONGEST_S:
        raise FlowFileError(path.name, f"{time_s[-1] - time_s[0]:.0f} s long", f"at most {LONGEST_S:.0f} s long")
