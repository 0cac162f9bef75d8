"""The bench beside the article's own instruments: laser line (Table 2 as it was made) and spirometer."""

from dataclasses import dataclass

import numpy as np

from engine.evaluation import published
from engine.evaluation.instruments import FIVE
from engine.evaluation.judged import Judged
from engine.evaluation.scores import correlation
from engine.evaluation.tables import Cell, Table
from engine.frames import FloatArray


@dataclass(frozen=True, slots=True, kw_only=True)
class Beside:
    """One method beside the laser line on one run: equation 9 at five points, and the correlation of motion there."""

    mean_mm: float
    largest_mm: float
    deviation_mm: float
    correlation: float


def beside_laser(one: Judged, name: str) -> Beside | None:
    """Compare ``ours`` or ``plain`` with the laser; None where one of them saw too little."""
    pair = _pair(one, name)
    if pair is None:
        return None
    laser, method = pair
    error = np.abs(laser - method)
    known = np.isfinite(error)
    if not known.any(axis=0).all():
        return None
    return Beside(
        mean_mm=float(np.nanmean(error)),
        largest_mm=float(np.nanmax(error)),
        deviation_mm=float(np.nanmean(np.nanstd(error, axis=0))),
        correlation=float(np.mean([correlation(laser[:, i], method[:, i]) for i in range(laser.shape[1])])),
    )


def along_line(one: Judged) -> FloatArray | None:
    """Correlate our motion with the laser's at every place along the line, shape (37,); None where there is no line."""
    found = one.outcome.instruments
    if "laser_mm" not in found:
        return None
    laser, ours = found["laser_mm"], found["laser_ours_mm"]
    curve = np.array([correlation(laser[:, i], ours[:, i]) for i in range(laser.shape[1])])
    return curve if np.isfinite(curve).any() else None


def _pair(one: Judged, name: str) -> tuple[FloatArray, FloatArray] | None:
    found = one.outcome.instruments
    if "laser_mm" not in found:
        return None
    if name == "ours":
        return found["laser_mm"][:, FIVE], found["laser_ours_mm"][:, FIVE]
    return found["laser_line_mm"], found["laser_plain_mm"]


def laser_table(judged: list[Judged]) -> Table:
    """Make Table 2 as the article made it: against the laser line."""
    rows: list[tuple[Cell, ...]] = []
    for one in sorted(judged, key=lambda one: one.run.name):
        if one.run.group != "table2" or "laser_mm" not in one.outcome.instruments:
            continue
        column = int(one.run.name[1:]) - 1
        cells: list[Cell] = [one.run.name]
        cells += [float(published.TABLE_2_MEAN_MM[:, column].mean()), float(published.TABLE_2_MAX_MM[:, column].max())]
        for name in ("plain", "ours"):
            found = beside_laser(one, name)
            cells += [None] * 3 if found is None else [found.mean_mm, found.largest_mm, found.correlation]
        rows.append(tuple(cells))
    if len(rows) > 1:
        rows.append(("average", *(_mean([row[i] for row in rows]) for i in range(1, len(rows[0])))))
    return Table(
        name="laser",
        title="Against the laser line, five points [mm] (Table 2, Figures 12 and 13)",
        columns=(
            "dataset",
            "article mean",
            "article max",
            *(f"{name} {what}" for name in ("plain", "ours") for what in ("mean", "max", "correlation")),
        ),
        rows=tuple(rows),
        digits=3,
        note="Equation 9 with the laser for truth, as in the article: the laser's own error and its noise in the frame "
        "of reference are part of it. The article's correlation: 0.98.",
    )


def spirometer_table(judged: list[Judged]) -> Table:
    """Tabulate volume against the spirometer."""
    rows: list[tuple[Cell, ...]] = []
    for one in sorted(judged, key=lambda one: one.run.name):
        notes = one.outcome.notes
        if one.run.group not in {"table2", "irregular"} or "spirometer_ours" not in notes:
            continue
        ours, plain = notes["spirometer_ours"], notes.get("spirometer_plain", {})
        rows.append(
            (
                f"{one.run.name} {one.run.scenario}",
                0.97,
                plain.get("correlation"),
                ours.get("correlation"),
                notes.get("spirometer_lag_s"),
                ours.get("lag_s"),
                ours.get("refused"),
            )
        )
    return Table(
        name="spirometer",
        title="Volume against the spirometer, correlation (Figure 11)",
        columns=("dataset", "article", "plain", "ours", "true lag [s]", "lag found [s]", "refused"),
        rows=tuple(rows),
        digits=4,
        note="The spirometer has a clock, an offset and noise of its own; its lag is looked for, as always.",
    )


def _mean(cells: list[Cell]) -> Cell:
    values = [cell for cell in cells if isinstance(cell, float)]
    return float(np.mean(values)) if values else None
