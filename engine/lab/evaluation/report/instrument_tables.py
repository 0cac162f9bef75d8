"""Tables of the comparison with the article's instruments: laser line (Table 2) and spirometer."""

from dataclasses import dataclass

import numpy as np

from engine.core.frames import FloatArray
from engine.lab.evaluation.instruments.instruments import FIVE
from engine.lab.evaluation.report import published
from engine.lab.evaluation.runs.scored_run import ScoredRun
from engine.lab.evaluation.runs.scores import correlation
from engine.lab.evaluation.table import Cell, Table


@dataclass(frozen=True, slots=True, kw_only=True)
class LaserAgreement:
    """One method against the laser line on one run: equation 9 at five points [mm], and the correlation of motion."""

    mean_mm: float
    largest_mm: float
    deviation_mm: float
    correlation: float


def compare_with_laser(one: ScoredRun, name: str) -> LaserAgreement | None:
    """Compare ``ours`` or ``plain`` with the laser; None if a point has no common measurement."""
    pair = _pair(one, name)
    if pair is None:
        return None
    laser, method = pair
    error = np.abs(laser - method)
    known = np.isfinite(error)
    if not known.any(axis=0).all():
        return None
    return LaserAgreement(
        mean_mm=float(np.nanmean(error)),
        largest_mm=float(np.nanmax(error)),
        deviation_mm=float(np.nanmean(np.nanstd(error, axis=0))),
        correlation=float(np.mean([correlation(laser[:, i], method[:, i]) for i in range(laser.shape[1])])),
    )


def along_line(one: ScoredRun) -> FloatArray | None:
    """Correlation of our motion with the laser's along the line, shape (37,); None where there is no line."""
    found = one.outcome.instruments
    if "laser_mm" not in found:
        return None
    laser, ours = found["laser_mm"], found["laser_ours_mm"]
    curve = np.array([correlation(laser[:, i], ours[:, i]) for i in range(laser.shape[1])])
    return curve if np.isfinite(curve).any() else None


def _pair(one: ScoredRun, name: str) -> tuple[FloatArray, FloatArray] | None:
    found = one.outcome.instruments
    if "laser_mm" not in found:
        return None
    if name == "ours":
        return found["laser_mm"][:, FIVE], found["laser_ours_mm"][:, FIVE]
    return found["laser_line_mm"], found["laser_plain_mm"]


def laser_table(scored: list[ScoredRun]) -> Table:
    """Table 2 against the laser line, as in the article."""
    rows: list[tuple[Cell, ...]] = []
    for one in sorted(scored, key=lambda one: one.run.name):
        if one.run.group != "table2" or "laser_mm" not in one.outcome.instruments:
            continue
        column = int(one.run.name[1:]) - 1
        cells: list[Cell] = [one.run.name]
        cells += [float(published.TABLE_2_MEAN_MM[:, column].mean()), float(published.TABLE_2_MAX_MM[:, column].max())]
        for name in ("plain", "ours"):
            found = compare_with_laser(one, name)
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
        note="Equation 9 with the laser as ground truth, as in the article: includes the laser's own error and its "
        "noise in the reference frame. The article's correlation: 0.98.",
    )


def spirometer_table(scored: list[ScoredRun]) -> Table:
    """Table of the volume against the spirometer's."""
    rows: list[tuple[Cell, ...]] = []
    for one in sorted(scored, key=lambda one: one.run.name):
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
        note="The spirometer has a clock, an offset and noise of its own; its lag is estimated.",
    )


def _mean(cells: list[Cell]) -> Cell:
    values = [cell for cell in cells if isinstance(cell, float)]
    return float(np.mean(values)) if values else None
