"""The head of a QA report and its table of checks."""

from datetime import UTC, datetime

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, Rectangle

from service.qa.report.style import DASH, INK, LINE, LOOKS, PALE, SOFT, number
from service.qa.schemas import QaResult, QaRunDetail, Verdict

ROW_IN, TALL_ROW_IN = 0.18, 0.24
Box = tuple[float, float, float, float]
COLUMNS = (
    ("check", 0.008, "left"),
    ("value", 0.478, "right"),
    ("expected", 0.568, "right"),
    ("off by", 0.656, "right"),
    ("warns beyond", 0.764, "right"),
    ("fails beyond", 0.872, "right"),
    ("verdict", 0.948, "center"),
)
LONGEST_DETAIL = 120
MOST_REMARKS = 8


def paint_head(figure: Figure, run: QaRunDetail, box: Box) -> None:
    """Draw the head: kind of QA, site, verdict, operator, times, calibration and baseline."""
    panel = _bare(figure, box)
    panel.text(0.0, 0.9, f"{run.kind.capitalize()} QA", fontsize=22, color=INK, fontweight="bold", va="center")
    place = " · ".join(part for part in (run.site, run.machine) if part) or "site and machine not named"
    panel.text(0.0, 0.7, place, fontsize=11, color=INK, va="center")
    _badge(panel, run.verdict or "fail", (0.79, 0.62, 0.21, 0.38), size=22)
    facts = (
        (0.0, "Operator", run.operator),
        (0.24, "Began, UTC", _moment(run.created_at)),
        (0.42, "Ended, UTC", _moment(run.ended_at)),
        (0.60, "Beam line", "SIMULATED" if run.is_simulated_beam else "the site's"),
        (0.74, "Calibration", (run.calibration_sha256 or DASH)[:12]),
        (0.90, "Baseline", "none fixed" if run.baseline_number is None else f"no. {run.baseline_number}"),
    )
    for x, name, value in facts:
        panel.text(x, 0.47, name, fontsize=6.5, color=SOFT, va="center")
        panel.text(x, 0.36, _cut(value, 26), fontsize=7.6, color=INK, va="center")
    counts = {verdict: sum(one.verdict == verdict for one in run.results) for verdict in LOOKS}
    said = f"{len(run.results)} checks: " + ", ".join(f"{counts[verdict]} {verdict}" for verdict in counts)
    panel.text(0.0, 0.19, said, fontsize=8, color=INK, va="center")
    if run.note:
        panel.text(0.3, 0.19, f"Note: {_cut(run.note, 95)}", fontsize=7, color=SOFT, va="center")
    if run.is_simulated:
        words = "SIMULATED FROM END TO END: a virtual plate, phantom and beam line. Counts for nothing."
        panel.text(0.0, 0.06, words, fontsize=8, color=INK, va="center", fontweight="bold")


def paint_table(figure: Figure, run: QaRunDetail, box: Box) -> None:
    """Draw the table of checks with values, expected values and bounds."""
    panel = _bare(figure, box)
    rows = table_rows(run)
    panel.set_ylim(rows, 0.0)
    remarks = _remarks(run)
    for order, (title, detail) in enumerate(remarks):
        at = len(run.results) + 1.75 + order
        panel.text(0.008, at, f"{title}: {_cut(detail, LONGEST_DETAIL)}", fontsize=6.8, color=INK, va="center")
    for name, x, side in COLUMNS:
        panel.text(x, 0.5, name, fontsize=6.5, color=SOFT, ha=side, va="center")
    panel.plot([0.0, 1.0], [1.0, 1.0], color=INK, linewidth=0.8)
    for order, one in enumerate(run.results):
        _paint_row(panel, one, order + 1.0)


def table_rows(run: QaRunDetail) -> float:
    """Return the number of table rows: head, checks, and remarks on checks that did not pass."""
    remarks = len(_remarks(run))
    return len(run.results) + 1.0 + (remarks + 0.4 if remarks else 0.0)


def _remarks(run: QaRunDetail) -> list[tuple[str, str]]:
    return [(one.title, one.detail) for one in run.results if one.verdict != "pass" and one.detail][:MOST_REMARKS]


def _paint_row(panel: Axes, one: QaResult, top: float) -> None:
    middle = top + 0.5
    if one.verdict != "pass":
        panel.add_patch(Rectangle((0.0, top), 1.0, 1.0, facecolor=PALE, linewidth=0))
    panel.plot([0.0, 1.0], [top + 1.0, top + 1.0], color=LINE, linewidth=0.4)
    title = panel.text(0.008, middle, one.title, fontsize=7.2, color=INK, va="center")
    if one.verdict != "pass":
        title.set_fontweight("bold")
    sign = "\N{PLUS-MINUS SIGN}" if one.sidedness == "absolute" else ""
    value = number(one.value, one.unit)
    if one.uncertainty is not None and one.value is not None:
        value = f"{number(one.value)} \N{PLUS-MINUS SIGN} {number(one.uncertainty)} {one.unit}".strip()
    has_expected = one.sidedness == "absolute"
    shown = (
        value if one.value is not None else "not measured",
        number(one.expected) if has_expected else "",
        number(one.deviation) if has_expected else "",
        f"{sign}{number(one.warn)}",
        f"{sign}{number(one.fail)}",
    )
    for text, (_, x, side) in zip(shown, COLUMNS[1:], strict=False):
        panel.text(x, middle, text, fontsize=7.2, color=INK, ha=side, va="center")
    _badge(panel, one.verdict, (0.9, top + 0.13, 0.096, 0.74), size=6.5)


def _badge(panel: Axes, verdict: Verdict, box: Box, *, size: float) -> None:
    """Draw a verdict in an outlined, tinted or solid box."""
    look = LOOKS[verdict]
    x, y, width, height = box
    face = look.color if look.is_solid else look.pale
    panel.add_patch(
        FancyBboxPatch(
            (x, y), width, height, boxstyle="square,pad=0", facecolor=face, edgecolor=look.color, linewidth=1.0
        )
    )
    panel.text(
        x + width / 2.0,
        y + height / 2.0,
        look.word,
        fontsize=size,
        color="white" if look.is_solid else look.color,
        fontweight="bold",
        ha="center",
        va="center_baseline",
    )


def _bare(figure: Figure, box: Box) -> Axes:
    panel = figure.add_axes(box)
    panel.set_axis_off()
    panel.set_xlim(0.0, 1.0)
    panel.set_ylim(0.0, 1.0)
    return panel


def _moment(at: datetime | None) -> str:
    return DASH if at is None else at.astimezone(UTC).strftime("%Y-%m-%d %H:%M:%S")


def _cut(text: str, most: int) -> str:
    return text if len(text) <= most else f"{text[: most - 1]}…"
