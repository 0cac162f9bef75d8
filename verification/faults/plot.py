"""Every trial's time from fault to line off as a dot, and every kind's bound as a line."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from verification.faults.table import Row

ROW_IN = 0.24


def draw(table: Sequence[Row], path: Path) -> None:
    """Write a PNG."""
    figure = Figure(figsize=(9.0, 1.2 + ROW_IN * len(table)), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for place, row in enumerate(table):
        times = [max(outcome.off_ms, 0.1) for outcome in row.outcomes if outcome.off_ms is not None]
        colors = ["#c62828" if outcome.is_red else "#1f6f8b" for outcome in row.outcomes if outcome.off_ms is not None]
        jitter = [place + ((index * 7) % 11 - 5) / 30 for index in range(len(times))]
        axes.scatter(times, jitter, s=9, c=colors, alpha=0.6, linewidths=0)
        bound_ms = row.kind.expected.bound_ms
        axes.plot([bound_ms, bound_ms], [place - 0.4, place + 0.4], color="#c62828", linewidth=1.5)
    axes.set_yticks(range(len(table)), [row.kind.code for row in table], fontsize=7)
    axes.set_ylim(len(table) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.set_xlim(1.0, 5000.0)
    axes.set_xlabel("from the fault to the line off, as the receiver saw it [ms]; red: the bound")
    axes.grid(visible=True, axis="x", alpha=0.3)
    figure.savefig(path)
