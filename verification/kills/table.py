"""What a campaign found, by moment: for a terminal, for a page, and as a picture."""

from collections.abc import Sequence
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.table import Table

from verification.faults.kinds import RECEIVER_MS
from verification.kills.moments import MOMENTS
from verification.kills.verdict import Outcome

LOST_MS = 1000.0
COLUMNS = (
    "killed",
    "kills",
    "beam was on",
    "off after, worst ms",
    "samples lost, worst ms",
    "transitions",
    "recovered",
    "red",
)


def rows(outcomes: Sequence[Outcome]) -> list[tuple[str, ...]]:
    """One row a moment that was tried, and one of all."""
    groups = [(moment.what, [one for one in outcomes if one.moment == moment.code]) for moment in MOMENTS]
    return [_row(what, group) for what, group in groups if group] + [_row("in all", outcomes)]


def markdown(outcomes: Sequence[Outcome]) -> str:
    """Return the table as a page has it."""
    lines = [f"| {' | '.join(COLUMNS)} |", f"|{'---|' * len(COLUMNS)}"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows(outcomes))]) + "\n"


def terminal_table(outcomes: Sequence[Outcome]) -> Table:
    """Return the table as a terminal has it."""
    table = Table(*COLUMNS)
    for row in rows(outcomes):
        table.add_row(*row)
    return table


def summary(outcomes: Sequence[Outcome]) -> dict[str, object]:
    """Return the campaign's figures."""
    return {
        "kills": len(outcomes),
        "red": sum(one.is_red for one in outcomes),
        "beam_was_on": sum(one.off_ms is not None for one in outcomes),
        "worst_off_ms": _worst(outcomes, "off_ms"),
        "worst_lost_ms": _worst(outcomes, "lost_ms"),
        "transitions": sum(one.steps for one in outcomes),
        "recovered": sum(one.recovered for one in outcomes),
        "kills_with_recovered": sum(one.recovered > 0 for one in outcomes),
        "offs_in_the_last_instant": sum(one.is_last_instant for one in outcomes),
        "within_30_ms_of_an_edge": sum(one.edge_ms is not None and one.edge_ms <= 30.0 for one in outcomes),
    }


def draw(outcomes: Sequence[Outcome], path: Path) -> None:
    """Write a PNG: how long until the line was off, how much was lost, how near to an edge it was killed."""
    figure = Figure(figsize=(10.0, 3.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    panels = (
        ("off_ms", "kill to line off [ms]", 240.0, RECEIVER_MS),
        ("lost_ms", "samples lost [ms]", 1200.0, LOST_MS),
        ("edge_ms", "kill behind the last edge [ms]", 300.0, None),
    )
    for axes, (name, label, most, bound) in zip(figure.subplots(1, 3), panels, strict=True):
        values = [min(value, most) for one in outcomes if (value := getattr(one, name)) is not None]
        axes.hist(values, bins=40, range=(0.0, most), color="#1f6f8b")
        if bound is not None:
            axes.axvline(bound, color="#c62828", linewidth=1.5)
        axes.set_xlabel(label)
        axes.set_ylabel("kills")
        axes.grid(visible=True, alpha=0.3)
    figure.savefig(path)


def _row(what: str, group: Sequence[Outcome]) -> tuple[str, ...]:
    figures = summary(group)
    numbers = ("kills", "beam_was_on", "worst_off_ms", "worst_lost_ms", "transitions", "recovered", "red")
    return (what, *(_said(figures[name]) for name in numbers))


def _said(value: object) -> str:
    return "-" if value is None else f"{value:.0f}" if isinstance(value, float) else str(value)


def _worst(outcomes: Sequence[Outcome], name: str) -> float | None:
    return max((value for one in outcomes if (value := getattr(one, name)) is not None), default=None)
