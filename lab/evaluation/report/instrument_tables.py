"""Tables of the comparison with the article's instruments: laser line (Table 2) and spirometer.

Published figures of the article (doi:10.3390/s17081840) and of other systems, for comparison.
"""

from dataclasses import dataclass

import numpy as np

from engine.core.frames import FloatArray
from lab.evaluation.instruments.instruments import FIVE
from lab.evaluation.runs.scores import ScoredRun, correlation
from lab.evaluation.table import Cell, Table

ARTICLE = "Wijenayake and Park, Sensors 2017, 17, 1840"
TABLE_3 = (
    ("Synchrony", "< 1.5 mm"),
    ("ExacTrac", "< 1.0 mm"),
    ("Calypso", "< 1.5 mm"),
    ("Yang et al.", "1.1 ± 0.8 mm"),
    ("Chen et al.", "4.25 ± 3.49 %"),
    ("Alnowami et al.", "3.1 ± 0.6 mm"),
)
ARTICLE_ERROR = "0.53 ± 0.25 mm"
# Table 2: five points (rows) of fifteen datasets (columns), mm.
# fmt: off
TABLE_2_MEAN_MM = np.array([
    [0.23, 0.66, 0.18, 0.27, 0.39, 0.36, 0.36, 0.21, 0.83, 0.45, 0.32, 0.36, 0.94, 0.43, 0.55],
    [0.39, 0.34, 0.33, 0.52, 0.22, 1.09, 0.47, 0.47, 0.85, 0.46, 0.30, 0.50, 0.52, 0.97, 0.38],
    [0.31, 0.85, 0.42, 0.50, 0.59, 0.41, 0.44, 0.74, 0.78, 0.70, 0.40, 0.63, 1.04, 0.57, 0.64],
    [0.42, 0.27, 0.28, 0.51, 0.34, 0.40, 0.36, 0.38, 1.18, 1.55, 0.69, 0.50, 0.74, 0.49, 0.41],
    [0.32, 0.43, 0.33, 0.29, 0.51, 0.89, 0.53, 0.70, 0.37, 0.43, 0.38, 0.70, 0.87, 0.63, 0.73],
])
TABLE_2_MAX_MM = np.array([
    [0.92, 2.69, 0.66, 1.14, 0.96, 1.41, 1.41, 0.77, 1.91, 1.45, 1.05, 1.47, 1.89, 1.24, 1.51],
    [1.10, 1.34, 0.84, 1.62, 0.66, 1.87, 1.37, 1.31, 1.72, 1.34, 0.79, 1.55, 1.56, 2.51, 1.38],
    [1.09, 1.90, 1.18, 1.29, 1.39, 1.28, 1.59, 1.81, 1.97, 1.83, 1.03, 1.89, 2.55, 1.56, 1.82],
    [0.95, 1.38, 0.77, 1.72, 0.91, 0.90, 1.03, 1.24, 2.45, 3.18, 1.52, 1.52, 1.86, 1.11, 1.02],
    [0.89, 2.23, 0.96, 1.61, 0.97, 1.68, 1.46, 1.59, 1.27, 1.35, 1.02, 2.04, 2.16, 1.63, 1.79],
])
TABLE_2_DEVIATION_MM = np.array([
    [0.19, 0.66, 0.13, 0.24, 0.22, 0.32, 0.32, 0.16, 0.47, 0.31, 0.23, 0.29, 0.50, 0.27, 0.38],
    [0.25, 0.31, 0.21, 0.38, 0.16, 0.40, 0.30, 0.33, 0.46, 0.32, 0.19, 0.34, 0.40, 0.66, 0.29],
    [0.25, 0.44, 0.26, 0.32, 0.34, 0.31, 0.34, 0.44, 0.50, 0.46, 0.26, 0.47, 0.65, 0.36, 0.40],
    [0.21, 0.27, 0.19, 0.46, 0.23, 0.24, 0.26, 0.27, 0.71, 0.67, 0.32, 0.43, 0.43, 0.32, 0.24],
    [0.22, 0.49, 0.21, 0.27, 0.23, 0.37, 0.40, 0.40, 0.29, 0.33, 0.25, 0.59, 0.56, 0.37, 0.42],
])
# fmt: on


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
        cells += [float(TABLE_2_MEAN_MM[:, column].mean()), float(TABLE_2_MAX_MM[:, column].max())]
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
