"""PDF report of a finished QA run: one or two A4 pages, the same bytes for the same run.

Each verdict is a word as well as a colour, and a failure is the darkest mark on the page, so the report is legible on a
black-and-white printer.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO

from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import FigureCanvasPdf, PdfPages
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.ticker import MaxNLocator

from service.qa.report.style import COMMANDED, INK, LINE, LOOKS, MEASURED, PALE, SOFT, number, plain_axes
from service.qa.report.table import ROW_IN, TALL_ROW_IN, paint_head, paint_table, table_rows
from service.qa.schemas import QaRunDetail, QaSeries, QaTrend, QaTrendPoint

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
WIDTH_IN, HEIGHT_IN, MARGIN_IN = 8.27, 11.69, 0.55
HEAD_IN, HEADING_IN, FOOT_IN = 1.75, 0.3, 0.65
TREND_IN, SERIES_IN, GAP_IN = 1.0, 1.5, 0.42
MOST_STRETCH, INDENT_IN = 1.3, 0.36
TRENDS_IN_ROW, SERIES_IN_ROW = 4, 2
MOST_TRENDS, MOST_SERIES = 16, 6
KEY_CHECKS = (
    *("camera_distance_mm", "camera_tilt_x_deg", "camera_tilt_y_deg", "plate_noise_mm"),
    *("plate_drift_mm", "plate_flatness_mm", "motion_offset_mm", "motion_error_mm", "motion_lag_ms"),
    *("gate_mean_delay_ms", "gate_delay_difference_ms", "duty_cycle_change_percent"),
    *("treatment_beam_off_ms", "hold_to_beam_off_ms", "beam_readback_off_ms", "fail_safe_hold_ms"),
)
TREND_WORDS = "Trend of the newest runs: deviation, or the figure itself; dashed warns, beyond the solid line fails"
METADATA = {"Title": "Tidegate QA report", "Creator": "Tidegate", "Producer": None, "CreationDate": None}


# Plots of a QA report: measured series, and the trend of each check with the site's bounds.
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


def report_pdf(run: QaRunDetail, trends: Sequence[QaTrend]) -> bytes:
    """Return the PDF of a run with the trends of its checks."""
    out = BytesIO()
    with PdfPages(out, metadata=METADATA) as pages:
        for figure in report_pages(run, trends):
            FigureCanvasPdf(figure)
            pages.savefig(figure)
    return out.getvalue()


def report_pages(run: QaRunDetail, trends: Sequence[QaTrend]) -> list[Figure]:
    """Draw the one or two pages of a report."""
    pages = [_page()]
    table_in = ROW_IN * table_rows(run)
    plots = _Plots(series=run.series[:MOST_SERIES], trends=_key_trends(trends))
    top_in = MARGIN_IN + HEAD_IN + table_in + 0.45
    fitting = plots.cut_to(HEIGHT_IN - FOOT_IN - top_in)
    if fitting is None:
        pages.append(_page())
        table_in = min(TALL_ROW_IN * table_rows(run), HEIGHT_IN - FOOT_IN - MARGIN_IN - HEAD_IN)
        fitting, top_in = plots, MARGIN_IN + 0.2
    paint_head(pages[0], run, _box(MARGIN_IN, HEAD_IN))
    paint_table(pages[0], run, _box(MARGIN_IN + HEAD_IN, table_in))
    _paint_plots(pages[-1], fitting, top_in)
    for place, page in enumerate(pages, start=1):
        _paint_foot(page, run, place, len(pages))
        for text in page.findobj(Text):
            text.set_parse_math(False)  # a dollar sign in a name must not start a formula
    return pages


def _key_trends(trends: Sequence[QaTrend]) -> list[QaTrend]:
    by_code = {trend.check: trend for trend in trends}
    keys = [code for code in KEY_CHECKS if code in by_code]
    others = [code for code in by_code if code not in keys]
    return [by_code[code] for code in [*keys, *others][:MOST_TRENDS]]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class _Plots:
    """The plots of a report."""

    series: Sequence[QaSeries]
    trends: Sequence[QaTrend]

    @property
    def height_in(self) -> float:
        """Height of all plots [inch]."""
        heads = HEADING_IN * (bool(self.series) + bool(self.trends))
        return self.series_rows * (SERIES_IN + GAP_IN) + self.trend_rows * (TREND_IN + GAP_IN) + heads

    @property
    def series_rows(self) -> int:
        return -(-len(self.series) // SERIES_IN_ROW)

    @property
    def trend_rows(self) -> int:
        return -(-len(self.trends) // TRENDS_IN_ROW)

    def cut_to(self, height_in: float) -> "_Plots | None":
        """Return the plots with the last trend rows removed until they fit; None if fewer than two rows remain."""
        for rows in range(self.trend_rows, min(1, self.trend_rows - 1), -1):
            fewer = _Plots(series=self.series, trends=self.trends[: rows * TRENDS_IN_ROW])
            if fewer.height_in <= height_in:
                return fewer
        return None


def _paint_plots(figure: Figure, plots: _Plots, top_in: float) -> None:
    stretch = min(MOST_STRETCH, (HEIGHT_IN - FOOT_IN - top_in) / max(plots.height_in, 1.0))
    if plots.series:
        _heading(figure, "What was measured", top_in)
        top_in += HEADING_IN
        for order, series in enumerate(plots.series):
            columns = min(SERIES_IN_ROW, len(plots.series))
            row, column = divmod(order, columns)
            panel_in = stretch * (SERIES_IN + GAP_IN)
            box = _cell(column, columns, top_in + row * panel_in, panel_in - GAP_IN)
            paint_series(figure.add_axes(box), series)
        top_in += plots.series_rows * stretch * (SERIES_IN + GAP_IN)
    if plots.trends:
        _heading(figure, TREND_WORDS, top_in)
        top_in += HEADING_IN
        for order, trend in enumerate(plots.trends):
            row, column = divmod(order, TRENDS_IN_ROW)
            panel_in = stretch * (TREND_IN + GAP_IN)
            box = _cell(column, TRENDS_IN_ROW, top_in + row * panel_in, panel_in - GAP_IN)
            paint_trend(figure.add_axes(box), trend)


def _page() -> Figure:
    return Figure(figsize=(WIDTH_IN, HEIGHT_IN), facecolor="white")


def _heading(figure: Figure, text: str, top_in: float) -> None:
    x, y, _, _ = _box(top_in, 0.0)
    figure.text(x, y, text, fontsize=8.0, color=SOFT, va="bottom")


def _paint_foot(figure: Figure, run: QaRunDetail, number: int, pages: int) -> None:
    y = 0.36 / HEIGHT_IN
    seal = f"run {run.id} · sha256 {(run.sha256 or '')[:12]} · Tidegate {run.software}"
    words = f"{seal} · research and commissioning only, not cleared for clinical use"
    figure.text(MARGIN_IN / WIDTH_IN, y, words, fontsize=5.6, color=SOFT)
    right = 1.0 - MARGIN_IN / WIDTH_IN
    figure.text(right, y, f"page {number} of {pages}", fontsize=5.8, color=INK, ha="right")
    edge, rule = MARGIN_IN / WIDTH_IN, y + 0.014
    figure.add_artist(Line2D([edge, 1.0 - edge], [rule, rule], color=LINE, linewidth=0.6))


def _box(top_in: float, height_in: float) -> tuple[float, float, float, float]:
    """Return a box of the page's width in figure coordinates; ``top_in`` counts from the top edge [inch]."""
    width_in = WIDTH_IN - 2.0 * MARGIN_IN
    return (
        MARGIN_IN / WIDTH_IN,
        1.0 - (top_in + height_in) / HEIGHT_IN,
        width_in / WIDTH_IN,
        height_in / HEIGHT_IN,
    )


def _cell(column: int, columns: int, top_in: float, height_in: float) -> tuple[float, float, float, float]:
    """Return the box of one of ``columns`` panels in a row, in figure coordinates."""
    gap_in = 0.42 if columns > SERIES_IN_ROW else 0.6
    whole_in = WIDTH_IN - 2.0 * MARGIN_IN - INDENT_IN
    width_in = (whole_in - (columns - 1) * gap_in) / columns
    left_in = MARGIN_IN + INDENT_IN + column * (width_in + gap_in)
    return left_in / WIDTH_IN, 1.0 - (top_in + height_in) / HEIGHT_IN, width_in / WIDTH_IN, height_in / HEIGHT_IN
