"""The trace of a whole session as SVG: least and most of the gated signal in each column, and when the beam was on."""

from html import escape

import numpy as np
import numpy.typing as npt

from service.sessions.report.figures import SampleColumns

WIDTH, HEIGHT = 900, 170
LEFT, BELOW = 46, 22
FONT = 'font-family="sans-serif" font-size="11"'
COLUMNS = WIDTH - LEFT
INK, BEAM, FAINT = "#0b4f8a", "#bfe8d2", "#5a6a77"
MOST_MARKS = 8
STEPS_S = (1, 2, 5, 10, 20, 30, 60, 120, 300, 600, 1200, 1800, 3600)


def trace_svg(columns: SampleColumns) -> str:
    """Draw the gated signal over the session's time; empty where nothing was measured."""
    seconds, values = columns.seconds, columns.numbers["signal_mm"]
    known = np.isfinite(values)
    if not known.any() or seconds[-1] <= 0.0:
        return ""
    low, high = float(values[known].min()), float(values[known].max())
    spare = max(0.05 * (high - low), 0.1)
    low, high = low - spare, high + spare
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" {FONT}>']
    parts += [
        f'<rect x="{x0:.1f}" y="0" width="{max(x1 - x0, 0.5):.1f}" height="{HEIGHT - BELOW}" fill="{BEAM}"/>'
        for x0, x1 in _beams(columns, seconds)
    ]
    parts.append(
        f'<path d="{_path(seconds[known], values[known], seconds[-1], low, high)}" stroke="{INK}" fill="none"/>'
    )
    for value in (low + spare, high - spare):
        y = float(_y(np.array(value), low, high)) + 4.0
        parts.append(f'<text x="{LEFT - 4}" y="{y:.1f}" text-anchor="end" fill="{FAINT}">{value:.1f}</text>')
    step_s = next((one for one in STEPS_S if seconds[-1] / one <= MOST_MARKS), STEPS_S[-1])
    for mark_s in np.arange(0.0, seconds[-1], step_s):
        x = LEFT + COLUMNS * mark_s / seconds[-1]
        parts.append(f'<text x="{x:.1f}" y="{HEIGHT - 6}" fill="{FAINT}">{escape(_clock(mark_s))}</text>')
    return "".join([*parts, "</svg>"])


def _beams(columns: SampleColumns, seconds: npt.NDArray[np.float64]) -> list[tuple[float, float]]:
    is_on = columns.texts["gate"] == "beam_on"
    edges = np.flatnonzero(np.diff(np.concatenate(([False], is_on, [False])).astype(np.int8))).reshape(-1, 2)
    ends = np.minimum(edges[:, 1], len(seconds) - 1)
    at = [LEFT + COLUMNS * seconds[side] / seconds[-1] for side in (edges[:, 0], ends)]
    return list(zip(at[0].tolist(), at[1].tolist(), strict=True))


def _path(
    seconds: npt.NDArray[np.float64], values: npt.NDArray[np.float64], end_s: float, low: float, high: float
) -> str:
    """Draw each pixel column from its least to its most; few samples are joined point by point."""
    if len(values) <= 2 * COLUMNS:
        xs, ys = LEFT + COLUMNS * seconds / end_s, _y(values, low, high)
        return "M" + " L".join(f"{x:.1f} {y:.1f}" for x, y in zip(xs, ys, strict=True))
    column = np.minimum((COLUMNS * seconds / end_s).astype(np.intp), COLUMNS - 1)
    starts = np.flatnonzero(np.diff(column, prepend=-1))
    least, most = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
    ends = zip(column[starts].tolist(), _y(least, low, high).tolist(), _y(most, low, high).tolist(), strict=True)
    return " ".join(f"M{LEFT + at} {bottom:.1f} V{top:.1f}" for at, bottom, top in ends)


def _y(values: npt.NDArray[np.float64], low: float, high: float) -> npt.NDArray[np.float64]:
    return np.asarray((HEIGHT - BELOW) * (high - values) / (high - low))


def _clock(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes}:{rest:02}"
