"""A plate's positions with times of this machine's clocks, from a CSV.

The header names the clock: ``time_utc,position_mm`` (RFC 3339 with a zone) or ``monotonic_s,position_mm`` (seconds of
this machine's monotonic clock).
"""

import csv
import hashlib
import io
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

from engine.core.errors import RecordingError
from engine.core.files import open_plain
from engine.verification.qa.trace import MAX_BYTES, CommandedTrace

UTC_COLUMN, MONOTONIC_COLUMN, POSITION_COLUMN = "time_utc", "monotonic_s", "position_mm"
NS_PER_S = 1_000_000_000


@dataclass(frozen=True, slots=True, kw_only=True)
class TimedTrace:
    """A plate's positions, the host monotonic time of their time 0 [ns], and the SHA-256 of the file, if it was one."""

    trace: CommandedTrace
    zero_ns: int
    sha256: str = ""


def read_timed_trace(path: Path, utc_less_monotonic_s: float) -> TimedTrace:
    """Read a trace.

    Parameters
    ----------
    utc_less_monotonic_s
        Seconds since 1970 less the monotonic clock's seconds, on this machine.

    Raises
    ------
    RecordingError
        The file cannot be read or parsed; names file and line.
    InvalidValueError
        The samples are too few, out of order, have gaps or move too little or too far.
    """
    content = _content(path)
    rows = list(csv.reader(io.StringIO(content.decode("utf-8-sig", errors="replace"))))
    header = rows[0] if rows else []
    if header not in ([UTC_COLUMN, POSITION_COLUMN], [MONOTONIC_COLUMN, POSITION_COLUMN]):
        bound = f"{UTC_COLUMN},{POSITION_COLUMN} or {MONOTONIC_COLUMN},{POSITION_COLUMN}"
        msg = f"{path.name}: line 1: is {','.join(header)[:40]!r}: must be {bound}"
        raise RecordingError(msg)
    off_s = utc_less_monotonic_s if header[0] == UTC_COLUMN else 0.0
    values = [_values(path.name, number, row, is_utc=bool(off_s)) for number, row in enumerate(rows[1:], start=2)]
    time_s, position_mm = np.array(values, dtype=np.float64).reshape(-1, 2).T.copy()
    zero_s = float(time_s[0]) if len(time_s) else 0.0
    trace = CommandedTrace(time_s=time_s - zero_s, position_mm=position_mm)
    zero_ns = round((zero_s - off_s) * NS_PER_S)
    return TimedTrace(trace=trace, zero_ns=zero_ns, sha256=hashlib.sha256(content).hexdigest())


def _content(path: Path) -> bytes:
    try:
        with open_plain(path) as file:
            content: bytes = file.read(MAX_BYTES + 1)
    except (OSError, ValueError) as error:  # a name with a NUL is a ValueError
        msg = f"{path.name}: cannot be read ({getattr(error, 'strerror', None) or error})"
        raise RecordingError(msg) from error
    if len(content) > MAX_BYTES:
        msg = f"{path.name}: is larger than {MAX_BYTES} bytes: too long for a trace"
        raise RecordingError(msg)
    return content


def _values(name: str, number: int, row: list[str], *, is_utc: bool) -> tuple[float, float]:
    try:
        time_text, position_text = row
        at = datetime.fromisoformat(time_text) if is_utc else None
        time_s = float(time_text) if at is None else at.timestamp()
        position_mm = float(position_text)
    except ValueError as error:
        clock = "an RFC 3339 time" if is_utc else "seconds"
        msg = f"{name}: line {number}: is {','.join(row)[:60]!r}: must be {clock} and a position in mm"
        raise RecordingError(msg) from error
    if at is not None and at.tzinfo is None:
        msg = f"{name}: line {number}: {time_text!r} has no zone: must end in Z or an offset"
        raise RecordingError(msg)
    return time_s, position_mm
