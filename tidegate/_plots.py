"""Plots of motion, signals and gating."""

import io
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from engine.core.errors import TidegateError
from engine.gating.windows import AmplitudeWindow
from tidegate._gating import Gating
from tidegate._motion import MotionSeries
from tidegate._signals import Signal

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SIZE_IN = (9.0, 3.6)
COLORS = {"whole": "0.35", "thorax": "tab:blue", "abdomen": "tab:orange"}


class PlotMissingError(TidegateError):
    """Matplotlib is not installed."""


def plot(shown: MotionSeries | Signal | Gating, path: str | Path | None = None) -> "Figure":
    """Return a figure of motion over time; thorax and abdomen of a series, beam-on times and window of a gating.

    Parameters
    ----------
    path
        Also written there, as its ending says (``.png``, ``.svg``, ``.pdf``).

    Raises
    ------
    PlotMissingError
        Matplotlib is not installed.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        msg = "tidegate.plot needs matplotlib: pip install 'tidegate[lab]'"
        raise PlotMissingError(msg) from error
    figure = Figure(figsize=SIZE_IN, layout="constrained")
    axes = figure.add_subplot()
    _draw(axes, shown)
    axes.set_xlabel("time [s]")
    axes.set_ylabel("motion [mm]")
    axes.margins(x=0.0)
    axes.spines[["top", "right"]].set_visible(False)
    if len(axes.lines) > 1 or isinstance(shown, Gating):
        axes.legend(frameon=False, ncols=4, loc="lower left", bbox_to_anchor=(0.0, 1.0))
    if path is not None:
        figure.savefig(path)
    setattr(figure, "_repr_png_", partial(_png, figure))  # noqa: B010 - what a notebook shows
    return figure


def _png(figure: "Figure") -> bytes:
    content = io.BytesIO()
    figure.savefig(content, format="png")
    return content.getvalue()


def _draw(axes: "Axes", shown: MotionSeries | Signal | Gating) -> None:
    if isinstance(shown, MotionSeries):
        for name in ("thorax", "abdomen"):
            signal = shown.signal(name)
            axes.plot(signal.time_s, signal.value_mm, color=COLORS[name], label=name, linewidth=1.2)
        return
    signal = shown.signal if isinstance(shown, Gating) else shown
    axes.plot(signal.time_s, signal.value_mm, color=COLORS["whole"], label=signal.name, linewidth=1.2)
    if isinstance(shown, Gating):
        if isinstance(shown.window, AmplitudeWindow):
            for edge in (shown.window.lower, shown.window.upper):
                axes.axhline(edge, color="tab:green", linewidth=0.8, linestyle="--")
        low, high = axes.get_ylim()
        is_on = np.asarray(shown.is_on).tolist()
        axes.fill_between(signal.time_s, low, high, where=is_on, color="tab:green", alpha=0.2, label="beam on")
        axes.set_ylim(low, high)
