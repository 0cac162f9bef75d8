"""The plots of a QA report as values: measured series, and the trend of each check with the site's bounds.

Places are shares of a panel's width and height, from its lower left corner; the template only draws them.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Any

from service.qa.report.style import COMMANDED, INK, LINE, LOOKS, MEASURED, SOFT, number
from service.qa.schemas import QaSeries, QaTrend, QaTrendPoint

STYLES = (
    *((COMMANDED, "dashed", 0.8), (MEASURED, "solid", 0.9)),
    *(("#9a5b00", "dotted", 1.1), ("#6b3fa0", "dash-dotted", 0.9)),
)
FEW_POINTS = 60
"""Up to so many points of a curve have a mark each."""
HEADROOM, SHOWN = 1.45, 0.96
"""The axis goes beyond what is shown, and a mark beyond this share of it lies at its edge, with its figure."""
LEGEND_SHARE = 0.18
LEAST_SPAN_MM = 2.0
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)
Panel = dict[str, Any]


def series_panel(series: QaSeries) -> Panel:
    """Return the panel of a measured series; its curves differ in line style and colour."""
    low_x, high_x = _span([at for curve in series.curves for at in curve.x])
    low, high = _span([value for curve in series.curves for value in curve.y])
    margin = max(0.05 * (high - low), (LEAST_SPAN_MM - (high - low)) / 2.0 if "mm" in series.y_label else 0.0)
    low, high = low - margin, high + margin
    has_legend = len(series.curves) > 1
    top = high + has_legend * LEGEND_SHARE * -(-len(series.curves) // 2) * (high - low)
    lines = []
    for (color, dash, width), curve in zip(STYLES if has_legend else STYLES[1:], series.curves, strict=False):
        points = [(_share(x, low_x, high_x), _share(y, low, top)) for x, y in zip(curve.x, curve.y, strict=True)]
        lines.append(
            {
                "name": curve.name if has_legend else "",
                "points": points,
                "color": color,
                "dash": dash,
                "width": width,
                "has_marks": len(points) <= FEW_POINTS,
            }
        )
    return {
        "title": series.title,
        "x_label": series.x_label,
        "y_label": series.y_label,
        "x_ticks": axis_ticks(low_x, high_x, 6),
        "y_ticks": axis_ticks(low, top, 5),
        "lines": lines,
    }


def trend_panel(trend: QaTrend) -> Panel:
    """Return the panel of a check's deviation per run: dashed warns, solid fails, the newest run ringed."""
    points = trend.items
    panel: Panel = {"title": trend.title, "unit": trend.unit, "x_ticks": [], "y_ticks": [], "lines": [], "marks": []}
    if not points:
        return panel
    top = HEADROOM * _reach(points)
    bottom = -top if trend.sidedness == "absolute" else -0.06 * top
    left, right = -0.8, max(len(points) + 0.3, 1.8)

    def place(at: float, value: float) -> tuple[float, float]:
        return _share(at, left, right), _share(value, bottom, top)

    signs = (1.0, -1.0) if trend.sidedness == "absolute" else (1.0,)
    edges = [left, *(at - 0.5 for at in range(1, len(points))), right]
    panel["bands"] = []
    for sign in signs:
        for name, dash, color in (("warn", "dashed", SOFT), ("fail", "solid", INK)):
            bounds = [sign * getattr(one, name) for one in points]
            steps = [
                place(at, bound) for number_, bound in enumerate(bounds) for at in (edges[number_], edges[number_ + 1])
            ]
            panel["lines"].append(_line(steps, color, dash, 0.6))
            if name == "fail":
                edge = 1.0 if sign > 0.0 else 0.0
                panel["bands"].append([*steps, (1.0, edge), (0.0, edge)])
    if trend.sidedness == "absolute":
        panel["lines"].append(_line([place(left, 0.0), place(right, 0.0)], LINE, "solid", 0.6))
    known = [place(at, one.deviation) for at, one in enumerate(points) if one.deviation is not None]
    panel["lines"].append(_line(known, LINE, "solid", 0.8))
    panel["marks"] = [
        _mark(one, place(at, _kept(one.deviation or 0.0, SHOWN * top)), SHOWN * top, is_newest=at == len(points) - 1)
        for at, one in enumerate(points)
    ]
    is_one_day = points[0].at.date() == points[-1].at.date()
    ends = sorted({0, len(points) - 1})
    panel["x_ticks"] = [
        (place(at, 0.0)[0], points[at].at.strftime("%H:%M" if is_one_day else "%d %b %y")) for at in ends
    ]
    panel["y_ticks"] = axis_ticks(bottom, top, 4)
    return panel


def _kept(value: float, most: float) -> float:
    return max(-most, min(value, most))


def _mark(one: QaTrendPoint, place: tuple[float, float], most: float, *, is_newest: bool) -> dict[str, Any]:
    look = LOOKS[one.verdict]
    is_beyond = one.deviation is not None and abs(one.deviation) > most
    return {
        "place": place,
        "shape": "cross" if one.deviation is None else look.marker,
        "color": look.color,
        "fill": look.color if one.verdict == "fail" else "#ffffff",
        "label": number(one.deviation) if is_beyond else "",
        "is_newest": is_newest and one.deviation is not None,
    }


def _line(points: Sequence[tuple[float, float]], color: str, dash: str, width: float) -> dict[str, Any]:
    return {"name": "", "points": points, "color": color, "dash": dash, "width": width, "has_marks": False}


def _reach(points: Iterable[QaTrendPoint]) -> float:
    """Return the largest deviation that is shown: the bounds', at most twice that for any deviation."""
    kept = list(points)
    bound = max(one.fail for one in kept)
    worst = max((abs(one.deviation) for one in kept if one.deviation is not None), default=0.0)
    limit = bound if bound > 0.0 else max(worst, 1.0)
    return min(max(limit, worst), 2.0 * limit)


def _span(values: Sequence[float]) -> tuple[float, float]:
    """Return the range of the values that are numbers; never empty."""
    known = [value for value in values if math.isfinite(value)]
    low, high = min(known, default=0.0), max(known, default=1.0)
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _share(value: float, low: float, high: float) -> float:
    return round((value - low) / (high - low), 5) if math.isfinite(value) else -1.0


def axis_ticks(low: float, high: float, most: int) -> list[tuple[float, str]]:
    """Return places and words of at most ``most`` round numbers."""
    raw = (high - low) / most
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(one * power for one in STEPS if one * power >= raw * (1.0 - 1e-9))
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [(_share(at * step, low, high), number(at * step)) for at in range(first, last + 1)]
