"""Figures beyond the article's: error maps of the body, breath holds, and sweeps.

Drawing for the report: one style, figures as PNG; no display and no global state of matplotlib is used.
"""

from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from engine.core.frames import FloatArray
from lab.evaluation.report.bench_tables import SWEEPS, of_group
from lab.evaluation.runs.scores import COLUMNS, SILENT_MM, ScoredRun

COLORS = {
    "truth": "#222222",
    "laser": "#c23b22",
    "spirometer": "#c23b22",
    "plain": "#e08a00",
    "ours": "#0f766e",
    "oracle": "#7c7c9c",
    "bilateral": "#9b5fc0",
}
LABELS = {
    "truth": "truth",
    "laser": "laser line",
    "spirometer": "spirometer",
    "plain": "plain method",
    "ours": "ours",
    "oracle": "oracle",
    "bilateral": "bilateral filter alone",
}
DPI = 110


@dataclass(frozen=True, slots=True, kw_only=True)
class Picture:
    """One figure of the page: its PNG, title and description."""

    name: str
    title: str
    note: str
    png: bytes


def draw(name: str, title: str, note: str, size: tuple[float, float], paint: Callable[[Figure], None]) -> Picture:
    """Draw a figure of ``size`` inches with ``paint`` and return it as PNG."""
    figure = Figure(figsize=size, dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    paint(figure)
    out = BytesIO()
    figure.savefig(out, format="png", metadata={"Software": None})
    return Picture(name=name, title=title, note=note, png=out.getvalue())


def shade_of(number: int, count: int) -> tuple[float, float, float, float]:
    """Return one of ``count`` distinguishable colours."""
    red, green, blue, alpha = colormaps["viridis"](0.92 * number / max(count - 1, 1))
    return (float(red), float(green), float(blue), float(alpha))


def axes_of(figure: Figure, rows: int, columns: int = 1, *, share_x: bool = False) -> list[Axes]:
    """Create panels with a light grid and return them row by row."""
    grid = np.atleast_1d(np.asarray(figure.subplots(rows, columns, sharex=share_x), dtype=object))
    panels: list[Axes] = list(grid.ravel())
    for panel in panels:
        panel.spines[["top", "right"]].set_visible(False)
        panel.grid(visible=True, color="#e6e6e6", linewidth=0.6)
        panel.set_axisbelow(True)
        panel.tick_params(labelsize=8)
    return panels


def line(panel: Axes, x: FloatArray, y: FloatArray, kind: str, *, width: float = 1.2, label: str | None = None) -> None:
    """Draw one method's curve in its colour; ``kind`` is a key of `COLORS`."""
    style = "--" if kind == "truth" else "-"
    name = LABELS[kind] if label is None else label
    panel.plot(x, y, style, color=COLORS[kind], linewidth=width, label=name)


def caption(panel: Axes, title: str, x: str = "", y: str = "") -> None:
    """Set the title and the axis labels of a panel."""
    panel.set_title(title, fontsize=9, loc="left")
    panel.set_xlabel(x, fontsize=8)
    panel.set_ylabel(y, fontsize=8)


def legend(panel: Axes, columns: int = 4) -> None:
    """Add a legend at the upper right."""
    panel.legend(fontsize=7, ncols=columns, frameon=False, loc="upper right")


def surface(
    figure: Figure, panel: Axes, values: FloatArray, title: str, limits: tuple[float, float], unit: str
) -> None:
    """Draw a surface on the ROI grid, shape (rows, columns), with a colour bar; superior is up."""
    panel.grid(visible=False)
    image = panel.imshow(
        values, vmin=limits[0], vmax=limits[1], cmap="viridis", aspect="equal", interpolation="nearest"
    )
    panel.set_title(title, fontsize=8)
    panel.set_xticks([])
    panel.set_yticks([])
    bar = figure.colorbar(image, ax=panel, shrink=0.85)
    bar.ax.tick_params(labelsize=7)
    bar.set_label(unit, fontsize=7)


def holds(scored: list[ScoredRun]) -> Picture | None:
    """Motion and error of the thorax in breath holds, where the article's method fails."""
    runs = [one for one in of_group(scored, "dibh") if "ours" in one.scores and "plain" in one.scores]
    if not runs:
        return None

    def paint(figure: Figure) -> None:
        panels = axes_of(figure, len(runs), 2)
        for number, one in enumerate(runs):
            left, right = panels[2 * number : 2 * number + 2]
            seconds, frames = one.outcome.seconds, one.frames
            own = one.true_motion("ours")[0]
            for kind in ("plain", "ours"):
                true = one.true_motion(kind)[0]
                motion = one.outcome.tracks[kind].wide_mm[:, 1]
                shift = (true - own)[frames][0, 1]
                line(left, seconds[frames], (motion - shift)[frames], kind)
                line(right, seconds[frames], (motion - true[:, 1])[frames], kind, width=0.9)
            line(left, seconds[frames], own[frames, 1], "truth")
            caption(left, f"{one.run.name}: thorax", "time [s]", "motion [mm]")
            caption(right, f"{one.run.name}: thorax, error", "time [s]", "error [mm]")
        legend(panels[0], 1)

    note = "No combination of the components learned from free breathing describes a breath hold."
    return draw("more_holds", "Breath holds with a model of free breathing", note, (10, 0.6 + 2.6 * len(runs)), paint)


def error_maps(scored: list[ScoredRun]) -> Picture | None:
    """Draw maps of the mean error over the fifteen datasets."""
    fifteen = of_group(scored, "table2")
    maps = {}
    for name in COLUMNS:
        found = [one.cell_maps_mm[name] for one in fifteen if name in one.cell_maps_mm]
        if found:
            maps[name] = np.nanmean(np.stack(found), axis=0)
    if not maps:
        return None
    highest = float(np.nanquantile(np.stack(list(maps.values())), 0.97))

    def paint(figure: Figure) -> None:
        for panel, (name, values) in zip(axes_of(figure, 1, len(maps)), maps.items(), strict=True):
            title = f"{LABELS[name]}: mean {np.nanmean(values):.3f} mm"
            surface(figure, panel, values, title, (0.0, highest), "mm")

    note = (
        "Mean error of each cell of 10 px over the datasets of Table 2; up is superior, left the patient's right. "
        "The brightest 3 % are cut off."
    )
    return draw("more_error_maps", "Error maps", note, (3.2 * len(maps), 4.4), paint)


def sweeps(scored: list[ScoredRun]) -> Picture | None:
    """Error as a function of distance, amplitude, frame rate and holes."""
    groups = [group for group in SWEEPS if of_group(scored, group)]
    if not groups:
        return None

    def paint(figure: Figure) -> None:
        for panel, group in zip(axes_of(figure, 1, len(groups)), groups, strict=True):
            runs = sorted(of_group(scored, group), key=lambda one: one.run.setting or 0.0)
            for name in COLUMNS:
                measured = [one for one in runs if name in one.scores]
                at = np.array([one.run.setting or 0.0 for one in measured])
                values = np.array([one.scores[name].cells_mm for one in measured])
                panel.plot(at, values, "o-", color=COLORS[name], markersize=3, linewidth=1.2, label=LABELS[name])
            ours = [one for one in runs if "ours" in one.scores]
            at = np.array([one.run.setting or 0.0 for one in ours])
            worst = np.array([one.scores["ours"].worst_frame_mm for one in ours])
            panel.plot(at, worst, ":", color=COLORS["ours"], linewidth=1.2, label="ours, worst frame")
            lost = [one.run.setting or 0.0 for one in runs if one.trust.lost_share > 0.5]
            for number, place in enumerate(lost):
                panel.axvline(place, color=COLORS["laser"], linewidth=1, label=None if number else "reported as lost")
            panel.axhline(SILENT_MM, color="#999999", linewidth=0.8, linestyle="--")
            panel.set_ylim(0.0, 1.2)
            caption(panel, "", SWEEPS[group], "error of a cell [mm]")
        legend(figure.axes[0], 1)

    note = "Mean over cells and frames; dotted, the worst frame. The dashed line is 1 mm."
    return draw(
        "more_sweeps", "Error against distance, amplitude, frame rate and holes", note, (3.2 * len(groups), 3.4), paint
    )


def segments(scored: list[ScoredRun]) -> Picture | None:
    """Draw motion and error of recordings in which the couch goes down, with the segments they are measured in."""
    runs = [one for one in of_group(scored, "couch") if "offline" in one.whole_scores]
    if not runs:
        return None

    def paint(figure: Figure) -> None:
        panels = axes_of(figure, len(runs), 2)
        for number, one in enumerate(runs):
            left, right = panels[2 * number : 2 * number + 2]
            seconds, true_mm = one.outcome.seconds, one.true_motion("offline")[0][:, 0]
            motion_mm = one.outcome.tracks["offline"].wide_mm[:, 0]
            line(left, seconds, motion_mm, "ours")
            line(left, seconds, true_mm, "truth")
            line(right, seconds, motion_mm - true_mm, "ours", width=0.9)
            for begun in one.outcome.notes["segments"]:
                left.axvline(seconds[begun["first_frame"]], color=COLORS["laser"], linewidth=1)
                place = (seconds[begun["first_frame"]], 0.02)
                left.annotate(begun["cause"], place, xycoords=left.get_xaxis_transform(), fontsize=7, rotation=90)
            caption(left, f"{one.run.name}, sensor {one.run.sensor}: whole region", "time [s]", "motion [mm]")
            caption(right, f"{one.run.name}: error", "time [s]", "error [mm]")
        legend(panels[0], 1)

    note = "The patient shifts while the couch goes down by 2 mm: every frame is measured, a line begins each segment."
    return draw("more_segments", "A patient and a couch that move", note, (10, 0.6 + 2.6 * len(runs)), paint)
