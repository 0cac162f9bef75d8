"""Drawing for the report: one style, figures as PNG; no display and no global state of matplotlib is used."""

from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from engine.core.frames import FloatArray

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
