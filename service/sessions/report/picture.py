"""The trace of a whole session as SVG: the gated signal with its window, when the beam was on, and the time of day."""

from collections.abc import Sequence
from datetime import datetime, timedelta
from html import escape

import numpy as np
import numpy.typing as npt

from service.core.schemas.reports import ReportEvent, ReportWindow
from service.sessions.report.figures import SampleColumns, beam_stretches

WIDTH, HEIGHT = 900, 210
LEFT, RIGHT, ABOVE, BELOW = 46, 12, 14, 22
FONT = 'font-family="sans-serif" font-size="11"'
COLUMNS, _DEPTH = WIDTH - LEFT - RIGHT, HEIGHT - BELOW - ABOVE
INK, BEAM, FAINT, BAND, MARK = "#0b4f8a", "#bfe8d2", "#5a6a77", "#b07a00", "#7a3fa0"
MOST_MARKS = 8
STEPS_S = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600)
STEPS_MM = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
GAP_S = 1.0
"""A longer time without a sample is a gap in the line."""
_Edges = list[tuple[float, float, float, float]]
MARKED = {"session.reference": "reference", "session.window": "window", "session.baseline_correction": "window moved"}


def trace_svg(
    columns: SampleColumns,
    windows: Sequence[ReportWindow] = (),
    events: Sequence[ReportEvent] = (),
    begin: datetime | None = None,
    unit: str = "mm",
) -> str:
    """Draw the gated signal over the session's time; empty where nothing was measured."""
    seconds, values = columns.seconds, columns.numbers["signal_mm"]
    known = np.isfinite(values)
    if not known.any() or seconds[-1] <= 0.0:
        return ""
    end_s = float(seconds[-1])
    edges = _edges(windows, begin, end_s)
    low, high = float(values[known].min()), float(values[known].max())
    low, high = min([low, *(one[2] for one in edges)]), max([high, *(one[3] for one in edges)])
    spare = max(0.05 * (high - low), 0.1)
    low, high = low - spare, high + spare
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" {FONT}>']
    for start, end in beam_stretches(columns):
        x0, x1 = _x(seconds[start], end_s), _x(seconds[min(end, len(seconds) - 1)], end_s)
        parts.append(
            f'<rect x="{x0:.1f}" y="{ABOVE}" width="{max(x1 - x0, 0.5):.1f}" height="{_DEPTH}" fill="{BEAM}"/>'
        )
    step = next((one for one in STEPS_MM if (high - low) / one <= MOST_MARKS), STEPS_MM[-1])
    for value in np.arange(np.ceil(low / step), np.floor(high / step) + 1) * step:
        y = _y(value, low, high)
        parts.append(f'<path d="M{LEFT} {y:.1f} H{WIDTH - RIGHT}" stroke="#e3e8ec"/>')
        parts.append(f'<text x="{LEFT - 4}" y="{y + 4:.1f}" text-anchor="end" fill="{FAINT}">{value + 0.0:g}</text>')
    parts.append(f'<text x="2" y="{ABOVE - 4}" fill="{FAINT}">{unit}</text>')
    for from_s, to_s, lower, upper in edges:
        for edge in (lower, upper):
            across = f"M{_x(from_s, end_s):.1f} {_y(edge, low, high):.1f} H{_x(to_s, end_s):.1f}"
            parts.append(f'<path d="{across}" stroke="{BAND}" stroke-dasharray="5 3"/>')
    parts.append(f'<path d="{_path(seconds[known], values[known], end_s, low, high)}" stroke="{INK}" fill="none"/>')
    for x, name in _marks(events, begin, end_s):
        parts.append(f'<path d="M{x:.1f} {ABOVE} v{_DEPTH}" stroke="{MARK}"/>')
        parts.append(f'<text x="{x + 3:.1f}" y="{ABOVE - 4}" fill="{MARK}">{escape(name)}</text>')
    step_s = next((one for one in STEPS_S if end_s / one <= MOST_MARKS), STEPS_S[-1])
    parts += [
        f'<text x="{_x(at_s, end_s):.1f}" y="{HEIGHT - 6}" fill="{FAINT}">{_clock(at_s, begin)}</text>'
        for at_s in np.arange(0.0, end_s, step_s)
    ]
    return "".join([*parts, "</svg>"])


def _edges(windows: Sequence[ReportWindow], begin: datetime | None, end_s: float) -> _Edges:
    """Return from, to, lower and upper edge of each window in turn; those in per cent or of a phase have none here."""
    spans: _Edges = []
    for number, one in enumerate(windows):
        from_s = 0.0 if begin is None else (one.at - begin).total_seconds()
        later = windows[number + 1].at if number + 1 < len(windows) else None
        to_s = end_s if later is None or begin is None else (later - begin).total_seconds()
        if one.lower is not None and one.upper is not None and to_s > 0.0 and from_s < end_s:
            spans.append((max(from_s, 0.0), min(to_s, end_s), one.lower, one.upper))
    return spans


def _marks(events: Sequence[ReportEvent], begin: datetime | None, end_s: float) -> list[tuple[float, str]]:
    """Return where the reference or the window was changed, and which."""
    if begin is None:
        return []
    found = [
        (one, (one.at - begin).total_seconds()) for one in events if one.action in MARKED and "refused" not in one.text
    ]
    return [(_x(at_s, end_s), MARKED[one.action]) for one, at_s in found if 0.0 <= at_s <= end_s]


def _path(
    seconds: npt.NDArray[np.float64], values: npt.NDArray[np.float64], end_s: float, low: float, high: float
) -> str:
    """Join of each pixel column the first, least, most and last sample, so that the line stays one; gaps are left."""
    column = (COLUMNS * seconds / end_s).astype(np.intp)
    starts = np.flatnonzero(np.diff(column, prepend=-1))
    kept = [
        start + place
        for start, end in zip(starts.tolist(), [*starts[1:].tolist(), len(values)], strict=True)
        for place in sorted({0, int(values[start:end].argmin()), int(values[start:end].argmax()), end - start - 1})
    ]
    parts, before_s = [], -np.inf
    for at in kept:
        step = "M" if seconds[at] - before_s > GAP_S else "L"
        parts.append(f"{step}{_x(seconds[at], end_s):.1f} {_y(values[at], low, high):.1f}")
        before_s = seconds[at]
    return " ".join(parts)


def _x(at_s: float, end_s: float) -> float:
    return LEFT + COLUMNS * float(at_s) / end_s


def _y(value: float, low: float, high: float) -> float:
    return ABOVE + _DEPTH * (high - float(value)) / (high - low)


def _clock(seconds: float, begin: datetime | None) -> str:
    """Return the site's time of day; the time since the first sample where it is not known."""
    if begin is not None:
        return f"{(begin + timedelta(seconds=float(seconds))).astimezone():%H:%M:%S}"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02}"
