"""Plots of a QA report: measured series, and the trend of each check with the site's bounds."""

from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from service.qa.report.style import COMMANDED, INK, LINE, LOOKS, MEASURED, PALE, SOFT, number, plain_axes
from service.qa.schemas import QaSeries, QaTrend, QaTrendPoint

STYLES = (
    {"color": COMMANDED, "linestyle": "--", "linewidth": 0.8},
    {"color": MEASURED, "linestyle": "-", "linewidth": 0.9},
    {"color": "#9a5b00", "linestyle": ":", "linewidth": 1.1},
    {"color": "#6b3fa0", "linestyle": "-.", "linewidth": 0.9},
)
FEW_POINTS = 60
HEADROOM = 1.45
LEGEND_SHARE = 0.18
LEAST_SPAN_MM = 2.0


def paint_trend(panel: Axes, trend: QaTrend) -> None:
    """Draw a check's deviation per run: dashed line warn, solid line fail, newest run ringed."""
    plain_axes(panel, trend.title, size=6.0)
    panel.text(
        0.985, 0.965, trend.unit, transform=panel.transAxes, ha="right", va="top", fontsize=5.8, color=SOFT, zorder=6
    )
    points = trend.items
    if not points:
        panel.text(0.5, 0.5, "no run yet", transform=panel.transAxes, ha="center", fontsize=6.5, color=SOFT)
        panel.set_xticks([])
        panel.set_yticks([])
        return
    numbers = range(len(points))
    _paint_bounds(panel, trend, points)
    known = [(at, one.deviation) for at, one in zip(numbers, points, strict=True) if one.deviation is not None]
    panel.plot([at for at, _ in known], [deviation for _, deviation in known], color=LINE, linewidth=0.8, zorder=2)
    top = _reach(points)
    for at, one in zip(numbers, points, strict=True):
        _paint_point(panel, at, one, top, is_newest=at == len(points) - 1)
    panel.set_ylim(-top if trend.sidedness == "absolute" else min(0.0, -0.06 * top), top)
    panel.set_xlim(-0.8, max(len(points) + 0.3, 1.8))
    ends = [0, len(points) - 1] if len(points) > 1 else [0]
    is_one_day = points[0].at.date() == points[-1].at.date()
    panel.set_xticks(ends, [points[at].at.strftime("%H:%M" if is_one_day else "%d %b %y") for at in ends])
    if len(ends) > 1:
        first, last = panel.get_xticklabels()
        first.set_horizontalalignment("left")
        last.set_horizontalalignment("right")
    panel.yaxis.set_major_locator(MaxNLocator(nbins=4))


def paint_series(panel: Axes, series: QaSeries) -> None:
    """Draw a measured series; its curves differ in line style and colour."""
    plain_axes(panel, series.title, size=7.0, is_bold=True)
    styles = STYLES if len(series.curves) > 1 else STYLES[1:]
    for order, curve in enumerate(series.curves):
        style = styles[order % len(styles)]
        is_scatter = len(curve.x) <= FEW_POINTS
        marker = {"marker": "o", "markersize": 2.2, "markerfacecolor": "white"} if is_scatter else {}
        panel.plot(curve.x, curve.y, label=curve.name, zorder=3 + order, **style, **marker)  # type: ignore[arg-type]
    panel.set_xlabel(series.x_label, fontsize=6.0, color=SOFT, labelpad=1.5)
    panel.set_ylabel(series.y_label, fontsize=6.0, color=SOFT, labelpad=1.5)
    panel.grid(visible=True, color=PALE, linewidth=0.7)
    panel.set_axisbelow(True)
    panel.margins(x=0.01)
    if len(series.curves) > 1:
        panel.legend(fontsize=5.8, ncols=2, loc="upper right", frameon=False, columnspacing=1.0, labelspacing=0.25)
    _give_room(panel, series)
    panel.yaxis.set_major_locator(MaxNLocator(nbins=5))
    panel.ticklabel_format(axis="y", style="plain", useOffset=False)


def _give_room(panel: Axes, series: QaSeries) -> None:
    """Add space for the legend above the curves and keep a span of at least LEAST_SPAN_MM."""
    low, high = panel.get_ylim()
    short = max(0.0, LEAST_SPAN_MM - (high - low)) if "mm" in series.y_label else 0.0
    low, high = low - short / 2.0, high + short / 2.0
    rows = len(series.curves) // 2  # two entries in a row
    room = LEGEND_SHARE * rows * (high - low)
    panel.set_ylim(low, high + room)


def _reach(points: list[QaTrendPoint]) -> float:
    """Return the axis limit: beyond the bounds, at most HEADROOM times twice the bound for any deviation."""
    bound = max(one.fail for one in points)
    worst = max((abs(one.deviation) for one in points if one.deviation is not None), default=0.0)
    limit = bound if bound > 0.0 else max(worst, 1.0)
    return HEADROOM * min(max(limit, worst), 2.0 * limit)


def _paint_bounds(panel: Axes, trend: QaTrend, points: list[QaTrendPoint]) -> None:
    numbers = [-1.0, *(at - 0.5 for at in range(1, len(points))), len(points) + 1.0]
    signs = (1.0, -1.0) if trend.sidedness == "absolute" else (1.0,)
    top = _reach(points)
    for sign in signs:
        warn, fail = ([sign * getattr(one, name) for one in [*points, points[-1]]] for name in ("warn", "fail"))
        panel.fill_between(numbers, fail, sign * 3.0 * top, step="post", color="#e4e7ea", linewidth=0, zorder=0)
        panel.step(numbers, warn, where="post", color=SOFT, linewidth=0.6, linestyle=(0, (3, 2)), zorder=1)
        panel.step(numbers, fail, where="post", color=INK, linewidth=0.7, zorder=1)
    if trend.sidedness == "absolute":
        panel.axhline(0.0, color=LINE, linewidth=0.6, zorder=1)


def _paint_point(panel: Axes, at: int, one: QaTrendPoint, top: float, *, is_newest: bool) -> None:
    look = LOOKS[one.verdict]
    if one.deviation is None:
        panel.text(at, 0.0, "\N{MULTIPLICATION SIGN}", ha="center", va="center", fontsize=8, color=look.color, zorder=4)
        return
    shown = max(-0.96 * top, min(one.deviation, 0.96 * top))
    face = look.color if one.verdict == "fail" else "white"
    panel.plot(
        [at],
        [shown],
        look.marker,
        color=look.color,
        markersize=3.4,
        markerfacecolor=face,
        markeredgewidth=0.9,
        zorder=4,
    )
    if shown != one.deviation:
        panel.annotate(
            number(one.deviation),
            (at, shown),
            (0, -7),
            textcoords="offset points",
            ha="center",
            fontsize=5.5,
            color=INK,
        )
    if is_newest:
        panel.plot([at], [shown], "o", color=INK, markersize=7.5, markerfacecolor="none", markeredgewidth=0.7, zorder=5)
