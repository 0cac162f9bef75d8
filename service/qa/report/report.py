"""PDF report of a finished QA run: one or two A4 pages, the same bytes for the same run.

Each verdict is a word as well as a colour, and a failure is the darkest mark on the page, so the report is legible on a
black-and-white printer.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from io import BytesIO

from matplotlib.backends.backend_pdf import FigureCanvasPdf, PdfPages
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Text

from service.qa.report.plots import paint_series, paint_trend
from service.qa.report.style import INK, LINE, SOFT
from service.qa.report.table import ROW_IN, TALL_ROW_IN, paint_head, paint_table, table_rows
from service.qa.schemas import QaRunDetail, QaSeries, QaTrend

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
    for number, page in enumerate(pages, start=1):
        _paint_foot(page, run, number, len(pages))
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
