"""Tables of the report: the article's value, the plain method's, ours and the oracle's side by side."""

from collections.abc import Callable, Iterable

import numpy as np

from lab.evaluation.report import instrument_tables
from lab.evaluation.report.instrument_tables import (
    LaserAgreement,
    compare_with_laser,
    laser_table,
    spirometer_table,
)
from lab.evaluation.runs.scores import COLUMNS, Score, ScoredRun
from lab.evaluation.table import Cell, Table
from lab.phantom.builds import find_build
from lab.phantom.sensor import SENSORS, USUAL

GROUPS = {
    "table2": "regular",
    "irregular": "irregular",
    "shift": "shift of the patient (after it)",
    "dibh": "breath hold (in the holds)",
    "isovolume": "isovolume (in the manoeuvre)",
}
KINDS = {
    "table2": "regular",
    "irregular": "irregular",
    "shift": "shift",
    "couch": "shift, couch 2 mm lower",
    "dibh": "breath hold",
    "isovolume": "isovolume",
    "drift": "drift",
}
SWEEPS = {"distance": "camera over the chest [mm]", "amplitude": "amplitude of the abdomen [mm]"}
SWEEPS |= {"rate": "frames per second", "holes": "share of the body without a reading"}
_METHODS = ("plain method", "ours", "oracle")


def all_tables(scored: list[ScoredRun]) -> list[Table]:
    """Return every table that has rows for these runs."""
    first = (glance, whole_roi, table_1, table_2, table_2_compared, laser_table, table_3)
    makers = (*first, spirometer_table, components, filters, spectra)
    usual = on_usual_sensor(scored)
    tables = [make(usual) for make in makers] + [sweep(usual, group) for group in SWEEPS]
    return [table for table in (accuracy(scored), *tables) if table.rows]


def on_usual_sensor(scored: Iterable[ScoredRun]) -> list[ScoredRun]:
    """Return the runs of the sensor that the article's tables are made with."""
    return [one for one in scored if one.run.sensor == USUAL]


def accuracy(scored: list[ScoredRun]) -> Table:
    """Accuracy by sensor and kind of breathing: every method side by side, and what the rest of ours consists of."""
    ran = [
        (f"{sensor}, {KINDS[group]}, {one.run.name}", one)
        for sensor in SENSORS
        for group in KINDS
        for one in of_group(scored, group)
        if one.run.sensor == sensor and "offline" in one.whole_scores
    ]
    return Table(
        name="accuracy",
        title="Accuracy by sensor: mean error of cells of 10 px [mm]",
        columns=(
            "sensor, breathing, recording",
            "plain, live",
            "ours, live",
            "smoothed PCA, whole",
            "ours, whole",
            "... constants out",
            "... and gains out",
            "oracle",
            "ours, worst frame",
            "ours, whole region",
            "ours, frames",
        ),
        rows=tuple((name, *_accuracy_of(one)) for name, one in ran),
        digits=3,
        note="Live: all frames after the training, as a session measures. Whole: every frame, as `tidegate measure` "
        "does. Constants out: without each cell's mean error, its share of the reference. Gains out: without what is "
        "proportional to its motion, the error of the components. What is left then is noise from frame to frame.",
        failed=frozenset(number for number, (_, one) in enumerate(ran) if _loses(one)),
    )


def _accuracy_of(one: ScoredRun) -> tuple[Cell, ...]:
    live, smoothed, ours = one.scores, one.whole_scores.get("smoothed"), one.whole_scores["offline"]
    plain, session, oracle = (
        None if (score := live.get(name)) is None else score.cells_mm for name in ("plain", "ours", "oracle")
    )
    return (
        plain,
        session,
        None if smoothed is None else smoothed.cells_mm,
        ours.cells_mm,
        ours.constants_out_mm,
        ours.gains_out_mm,
        oracle,
        ours.worst_frame_mm,
        ours.whole_mm,
        f"{one.whole_share['offline']:.1%}",
    )


def _loses(one: ScoredRun) -> bool:
    """Whether the simple method is better than ours."""
    smoothed = one.whole_scores.get("smoothed")
    return smoothed is not None and one.whole_scores["offline"].cells_mm > smoothed.cells_mm


def of_group(scored: list[ScoredRun], group: str) -> list[ScoredRun]:
    """Return the runs of a group, sorted by name."""
    return sorted((one for one in scored if one.run.group == group), key=lambda one: one.run.name)


def table_1(scored: list[ScoredRun]) -> Table:
    """Table 1: parameters of the volunteers."""
    fifteen = of_group(scored, "table2")
    rows: list[tuple[Cell, ...]] = []
    for volunteer in sorted({one.run.volunteer for one in fifteen}):
        build = find_build(volunteer)
        sets = ", ".join(one.run.name for one in fifteen if one.run.volunteer == volunteer)
        rows.append((volunteer, build.bmi, build.amplitude_mm, build.period_s, build.camera_mm, sets))
    return Table(
        name="table1",
        title="Table 1: the volunteers",
        columns=("volunteer", "BMI", "amplitude [mm]", "period [s]", "camera over chest [mm]", "datasets"),
        rows=tuple(rows),
        digits=1,
        note="Virtual volunteers with the body mass indices of the article's ten; all other parameters are invented.",
    )


def glance(scored: list[ScoredRun]) -> Table:
    """Summary: one row for each figure of the article."""
    fifteen = of_group(scored, "table2")
    rows = [
        ("Five points, mean error [mm]", None, *_over(fifteen, lambda s: np.mean(s.points_mm))),
        ("Five points, mean of the maxima [mm]", None, *_over(fifteen, lambda s: np.mean(s.points_max_mm))),
        ("Five points, largest of all [mm]", None, *_over(fifteen, lambda s: max(s.points_max_mm), np.max)),
        ("Five points, correlation of motion", None, *_over(fifteen, lambda s: s.points_correlation)),
        ("Volume, correlation", None, *_over(fifteen, lambda s: s.volume_correlation)),
        (
            "Five points against the laser, error [mm]",
            instrument_tables.ARTICLE_ERROR,
            *_laser(fifteen, lambda b: b.mean_mm),
        ),
        ("Five points against the laser, correlation", "0.98", *_laser(fifteen, lambda b: b.correlation)),
        ("Volume against the spirometer, correlation", "0.97", *_spirometer(fifteen)),
        ("Whole ROI, error of a cell, regular [mm]", None, *_over(fifteen, lambda s: s.cells_mm)),
        *(
            (f"... {GROUPS[group]} [mm]", None, *_over(of_group(scored, group), lambda s: s.cells_mm))
            for group in ("irregular", "shift", "dibh", "isovolume")
        ),
        ("Whole-ROI mean motion [mm]", None, *_over(fifteen, lambda s: s.whole_mm)),
        (
            "Isovolume, thorax against abdomen",
            "-0.99",
            *_over(of_group(scored, "isovolume"), lambda s: s.halves_correlation),
        ),
    ]
    return Table(
        name="glance",
        title="At a glance",
        columns=("figure", "article", *_METHODS),
        rows=tuple(row for row in rows if any(cell is not None for cell in row[2:])),
        digits=3,
        note="Against the truth, unless laser or spirometer are named, which have an error of their own and are the "
        "only comparison in the article. Its 15 datasets are of people, ours are virtual. Its largest error: 3.18 mm.",
    )


def table_2(scored: list[ScoredRun]) -> Table:
    """Our errors in the layout of the article's Table 2."""
    fifteen = [one for one in of_group(scored, "table2") if "ours" in one.scores]
    parts: tuple[tuple[str, Callable[[Score], tuple[float, ...]]], ...] = (
        ("average", lambda s: s.points_mm),
        ("max.", lambda s: s.points_max_mm),
        ("standard deviation", lambda s: s.points_deviation_mm),
    )
    rows: list[tuple[Cell, ...]] = []
    for point in range(5 if fifteen else 0):
        for name, part in parts:
            values = [part(one.scores["ours"])[point] for one in fifteen]
            rows.append((f"P{point + 1} {name}", *values, float(np.mean(values))))
    return Table(
        name="table2",
        title="Table 2: motion error at five points, ours [mm]",
        columns=("position", *(one.run.name for one in fifteen), "average"),
        rows=tuple(rows),
        note="Equation 9 against the truth, over all frames after the learning.",
    )


def table_2_compared(scored: list[ScoredRun]) -> Table:
    """Errors at the five points of each dataset: article, plain method, ours and oracle."""
    fifteen = of_group(scored, "table2")
    rows: list[tuple[Cell, ...]] = []
    for one in fifteen:
        column = int(one.run.name[1:]) - 1
        cells: list[Cell] = [one.run.name]
        cells += [
            float(instrument_tables.TABLE_2_MEAN_MM[:, column].mean()),
            float(instrument_tables.TABLE_2_MAX_MM[:, column].max()),
        ]
        cells.append(float(instrument_tables.TABLE_2_DEVIATION_MM[:, column].mean()))
        for name in COLUMNS:
            score = one.scores.get(name)
            if score is None:
                cells += [None, None, None]
                continue
            cells += [float(np.mean(score.points_mm)), max(score.points_max_mm)]
            cells.append(float(np.mean(score.points_deviation_mm)))
        rows.append(tuple(cells))
    if len(rows) > 1:
        columns = zip(*(row[1:] for row in rows), strict=True)
        rows.append(("average", *(_mean(column) for column in columns)))
    return Table(
        name="table2_compared",
        title="Table 2, four columns: mean, maximum and deviation over the five points [mm]",
        columns=(
            "dataset",
            *(
                f"{method} {what}"
                for method in ("article", "plain", "ours", "oracle")
                for what in ("mean", "max", "dev.")
            ),
        ),
        rows=tuple(rows),
    )


def table_3(scored: list[ScoredRun]) -> Table:
    """Table 3: published errors of other systems, and ours."""
    fifteen = of_group(scored, "table2")
    rows: list[tuple[Cell, ...]] = [(*row, "as published") for row in instrument_tables.TABLE_3]
    rows.append(("Article", instrument_tables.ARTICLE_ERROR, "against a laser line, fifteen datasets of ten people"))
    names = {"plain": "Plain method of the article", "ours": "Tidegate", "oracle": "Oracle"}
    for name, title in names.items():
        scores = [one.scores[name] for one in fifteen if name in one.scores]
        if scores:
            values = [value for score in scores for value in score.points_mm]
            text = f"{np.mean(values):.2f} ± {np.std(values):.2f} mm"
            rows.append((title, text, f"against the truth, {len(scores)} virtual datasets"))
    return Table(
        name="table3",
        title="Table 3: comparison with other systems",
        columns=("system", "error", "how"),
        rows=tuple(rows),
    )


def whole_roi(scored: list[ScoredRun]) -> Table:
    """Errors over the whole region, by scenario."""
    rows: list[tuple[Cell, ...]] = []
    for group, title in GROUPS.items():
        for one in of_group(scored, group):
            scores = [one.event_scores.get(name) for name in COLUMNS]
            means = (None if score is None else score.cells_mm for score in scores)
            worst = (None if score is None else score.worst_frame_mm for score in scores)
            largest = None if scores[1] is None else scores[1].largest_mm
            lost = f"{one.trust.lost_share:.1%}"
            rows.append((f"{one.run.name} {title}", *means, *worst, largest, lost, one.trust.silently_wrong))
    return Table(
        name="whole_roi",
        title="The whole region: mean error of cells of 10 px, and the worst frame's [mm]",
        columns=(
            "recording",
            *(f"{name} mean" for name in _METHODS),
            *(f"{name} worst frame" for name in _METHODS),
            "ours largest cell",
            "ours lost",
            "ours silently wrong",
        ),
        rows=tuple(rows),
        digits=3,
        note="The article gives no such figure. Silently wrong: frames in which whole, thorax, abdomen or one of the "
        "five points was off by 1 mm or more while the residual was within a gate's limits.",
    )


def components(scored: list[ScoredRun]) -> Table:
    """Errors with one and with three components on the long runs (Figures 16 and 17)."""
    rows: list[tuple[Cell, ...]] = []
    article = {
        ("regular", 1): "0.3 and 0.8",
        ("irregular", 3): "about 0.5",
        ("irregular", 1): "large",
    }
    for one in sorted(scored, key=lambda one: one.run.name):
        if not one.run.is_long:
            continue
        for count, suffix in ((1, "1"), (3, "")):
            scores = [one.scores.get(f"{name}{suffix}") for name in ("plain", "ours")]
            values = (None if score is None else float(np.mean(score.points_mm)) for score in scores)
            cells = (None if score is None else score.cells_mm for score in scores)
            article_value = article.get((one.run.scenario, count))
            rows.append(
                (f"{one.run.name} {one.run.scenario}, {count} of the components", article_value, *values, *cells)
            )
    return Table(
        name="components",
        title="Long runs with one component and with three [mm] (Figures 16 and 17)",
        columns=("recording", "article, points", "plain, points", "ours, points", "plain, cells", "ours, cells"),
        rows=tuple(rows),
        digits=3,
        note="Our method also fits low-order cosines, so one component instead of three changes its error little.",
    )


def filters(scored: list[ScoredRun]) -> Table:
    """Errors of the bilateral filter alone and of PCA (Figure 14)."""
    rows: list[tuple[Cell, ...]] = []
    for one in scored:
        if "bilateral" not in one.scores:
            continue
        for name, title, article_value in (
            ("bilateral", "bilateral filter alone", "0.85"),
            ("plain", "plain method, PCA", "0.35"),
            ("ours", "ours", None),
            ("oracle", "oracle", None),
        ):
            score = one.scores[name]
            rows.append(
                (title, article_value, float(np.mean(score.points_mm)), max(score.points_max_mm), score.cells_mm)
            )
    return Table(
        name="filters",
        title="Bilateral filter instead of PCA, dataset D01 [mm] (Figure 14)",
        columns=("method", "article, one place", "five points", "five points, largest", "cells"),
        rows=tuple(rows),
        digits=3,
    )


def spectra(scored: list[ScoredRun]) -> Table:
    """Variance explained by the first components (Figure 5)."""
    rows: list[tuple[Cell, ...]] = []
    for one in sorted(scored, key=lambda one: one.run.name):
        if one.run.group not in {"table2", "irregular"} or "ours" not in one.outcome.spectra:
            continue
        article_value = "over 98 % in one" if one.run.group == "table2" else "98 % in three"
        cells: list[Cell] = [f"{one.run.name} {one.run.scenario}", article_value]
        for name in ("plain", "ours"):
            shares = 100.0 * np.cumsum(one.outcome.spectra[name])
            cells += [float(shares[0]), float(shares[2])]
        rows.append(tuple(cells))
    return Table(
        name="spectra",
        title="Variance explained by the first component and by the first three [%] (Figure 5)",
        columns=("dataset", "article", "plain, one", "plain, three", "ours, one", "ours, three"),
        rows=tuple(rows),
        digits=1,
        note="Of the training frames' variance: the remainder is mostly the sensor's noise, which filtering reduces "
        "only partly; the article's frames were smoother.",
    )


def sweep(scored: list[ScoredRun], group: str) -> Table:
    """Errors of one sweep."""
    runs = sorted(of_group(scored, group), key=lambda one: one.run.setting or 0.0)
    return Table(
        name=f"sweep_{group}",
        title=f"Error against {SWEEPS[group]}",
        columns=(
            SWEEPS[group],
            *(f"{name} mean" for name in _METHODS),
            "ours worst frame",
            "ours largest cell",
            "ours worst point",
            "lost",
            "reasons (frames)",
            "largest residual",
            "valid pixels",
            "wrong by 1 mm",
            "silently",
        ),
        rows=tuple(_sweep_row(one) for one in runs),
        digits=3,
        note="In mm, mean over cells of 10 px and frames. Wrong by 1 mm: frames in which whole, thorax, abdomen or one "
        "of the five points was; silently: those that pass the frame checks with the gate's default limits.",
        failed=frozenset(number for number, one in enumerate(runs) if one.trust.silently_wrong),
    )


def _sweep_row(one: ScoredRun) -> tuple[Cell, ...]:
    scores, trust = [one.scores.get(name) for name in COLUMNS], one.trust
    ours = scores[1]
    reasons = ", ".join(f"{reason} {count}" for reason, count in sorted(one.outcome.notes["lost"].items()))
    return (
        f"{one.run.setting:g}",
        *(None if score is None else score.cells_mm for score in scores),
        *((None, None, None) if ours is None else (ours.worst_frame_mm, ours.largest_mm, max(ours.points_max_mm))),
        f"{trust.lost_share:.0%}",
        reasons,
        trust.largest_residual_mm,
        None if np.isnan(trust.valid_share) else f"{trust.valid_share:.0%}",
        trust.wrong,
        trust.silently_wrong,
    )


def _over(
    scored: Iterable[ScoredRun], value_of: Callable[[Score], object], over: Callable[[list[float]], object] = np.mean
) -> tuple[Cell, ...]:
    """Summarise a figure of each method over runs by ``over``; None where it is missing."""
    cells: list[Cell] = []
    runs = list(scored)
    for name in COLUMNS:
        values = [float(np.asarray(value_of(one.event_scores[name]))) for one in runs if name in one.event_scores]
        cells.append(float(np.asarray(over(values))) if values and np.isfinite(values).all() else None)
    return tuple(cells)


def _laser(scored: list[ScoredRun], value_of: Callable[[LaserAgreement], float]) -> tuple[Cell, ...]:
    """Mean of a figure against the laser for the plain method and ours; the oracle has none."""
    cells: list[Cell] = []
    for name in ("plain", "ours"):
        values = [value_of(found) for one in scored if (found := compare_with_laser(one, name)) is not None]
        cells.append(float(np.mean(values)) if values else None)
    return (*cells, None)


def _spirometer(scored: list[ScoredRun]) -> tuple[Cell, ...]:
    cells: list[Cell] = []
    for name in ("plain", "ours"):
        found = [one.outcome.notes.get(f"spirometer_{name}", {}).get("correlation") for one in scored]
        values = [value for value in found if value is not None]
        cells.append(float(np.mean(values)) if values else None)
    return (*cells, None)


def _mean(column: Iterable[Cell]) -> Cell:
    values = [cell for cell in column if isinstance(cell, float)]
    return float(np.mean(values)) if values else None
