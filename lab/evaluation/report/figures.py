"""The article's figures from the evaluation's runs: ours, the plain method and the truth on the same axes.

A figure is drawn if its runs are present.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from engine.core.frames import FloatArray
from lab.evaluation.instruments.instruments import FIVE, LINE_SHARES
from lab.evaluation.report.bench_tables import of_group
from lab.evaluation.report.instrument_tables import along_line
from lab.evaluation.report.more_figures import (
    COLORS,
    Picture,
    axes_of,
    caption,
    draw,
    error_maps,
    holds,
    legend,
    line,
    segments,
    shade_of,
    surface,
    sweeps,
)
from lab.evaluation.runs.scores import ScoredRun

POINT = 3
"""Index of the fourth of the five points, on the right of the abdomen near the laser line."""


def all_figures(scored: list[ScoredRun]) -> list[Picture]:
    """Draw every figure whose runs are present."""
    makers = (
        spectra,
        regular_coefficients,
        irregular_coefficients,
        reconstructions,
        volumes,
        motions,
        along_laser,
        filters,
        isovolume,
        long_regular,
        long_irregular,
        holds,
        error_maps,
        segments,
        sweeps,
    )
    return [picture for make in makers if (picture := make(scored)) is not None]


def spectra(scored: list[ScoredRun]) -> Picture | None:
    """Figure 5: the first ten eigenvalues."""
    parts = [
        ("regular", _spread(of_group(scored, "table2"), 5)),
        ("irregular", _spread(of_group(scored, "irregular"), 3)),
    ]
    parts = [(title, [one for one in runs if "ours" in one.outcome.spectra]) for title, runs in parts]
    parts = [part for part in parts if part[1]]
    if not parts:
        return None

    def paint(figure: Figure) -> None:
        for panel, (title, runs) in zip(axes_of(figure, 1, len(parts)), parts, strict=True):
            for number, one in enumerate(runs):
                for kind in ("plain", "ours"):
                    shares = 100.0 * one.outcome.spectra[kind]
                    panel.semilogy(
                        np.arange(1, len(shares) + 1),
                        shares,
                        "o-",
                        color=COLORS[kind],
                        markersize=3,
                        linewidth=1,
                        alpha=0.8,
                        label={"plain": "plain method", "ours": "ours"}[kind] if number == 0 else None,
                    )
            panel.set_ylim(0.01, 120.0)
            caption(panel, f"{title}: {', '.join(one.run.name for one in runs)}", "component", "share of variance [%]")
            legend(panel, 1)

    note = (
        "In regular breathing one component dominates, in irregular breathing several. From the third on it is noise."
    )
    return draw("fig05_spectra", "Figure 5: eigenvalues of the training frames", note, (9, 3.4), paint)


def regular_coefficients(scored: list[ScoredRun]) -> Picture | None:
    """Figure 6: projection on the first three components, regular."""
    note = (
        "In the article only the first component follows the breath. Here the second does as well, since these chests "
        "lag behind their abdomens."
    )
    title = "Figure 6: coefficients of the first three components, regular breathing"
    return _coefficients("fig06_coefficients_regular", title, note, _spread(of_group(scored, "table2"), 3))


def irregular_coefficients(scored: list[ScoredRun]) -> Picture | None:
    """Figure 7: projection on the first three components, irregular."""
    note = "The second component follows the breath as well, the third slightly."
    title = "Figure 7: coefficients of the first three components, irregular breathing"
    return _coefficients("fig07_coefficients_irregular", title, note, of_group(scored, "irregular")[:2])


def _coefficients(name: str, title: str, note: str, runs: list[ScoredRun]) -> Picture | None:
    runs = [one for one in runs if one.scores.get("ours") is not None]
    if not runs:
        return None

    def paint(figure: Figure) -> None:
        panels = axes_of(figure, 1, len(runs))
        for panel, one in zip(panels, runs, strict=True):
            beta = one.outcome.tracks["ours"].beta / np.sqrt(70_000.0)
            for component, shade in enumerate(("#0f766e", "#e08a00", "#7c7c9c")):
                label = f"component {component + 1}"
                panel.plot(one.outcome.seconds, beta[:, component], color=shade, linewidth=1, label=label)
            caption(panel, one.run.name, "time [s]", "coefficient, mean motion it makes [mm]")
            _trim(panel, one)
        legend(panels[0], 1)

    return draw(name, title, note, (4.2 * len(runs) + 0.6, 3.2), paint)


def reconstructions(scored: list[ScoredRun]) -> Picture | None:
    """Figure 8: effect of filtering the training frames, and of holes on the reconstruction."""
    one = next((one for one in scored if one.outcome.pictures), None)
    if one is None:
        return None
    pictures = one.outcome.pictures
    truth = pictures["truth"]
    limits = (float(truth.min()), float(truth.max()))
    modes = [
        ("unfiltered_component", "(b) 1st component, no filter"),
        ("plain_component", "(a) 1st component, filtered"),
    ]
    modes.append(("ours_component", "1st component, ours"))
    surfaces = [
        ("frame", "(e) a frame with its holes"),
        ("unfiltered", "(d) reconstructed with (b)"),
        ("plain", "(f) reconstructed with (a)"),
        ("ours", "reconstructed, ours"),
    ]

    def paint(figure: Figure) -> None:
        panels = axes_of(figure, 2, 4)
        for panel, (key, title) in zip(panels, modes, strict=False):
            mode = np.abs(pictures[key]) * np.sqrt(mode_size)
            surface(figure, panel, mode, title, (0.0, float(np.quantile(mode, 0.995))), "relative motion")
        surface(figure, panels[3], truth, "the truth at that moment", limits, "mm")
        for panel, (key, title) in zip(panels[4:], surfaces, strict=True):
            shown = np.where(pictures[key] == 0, np.nan, pictures[key])
            surface(figure, panel, shown, title, limits, "mm")

    mode_size = float(truth.size)
    note = (
        "Without filling and filtering, the first component describes flickering holes instead of the chest's motion, "
        "and so does a frame reconstructed with it. White: no reading."
    )
    return draw("fig08_reconstruction", f"Figure 8: holes and reconstruction, {one.run.name}", note, (10, 7.4), paint)


def volumes(scored: list[ScoredRun]) -> Picture | None:
    """Figure 11: volume against the spirometer, both from -1 to 1."""
    runs = _spread([one for one in of_group(scored, "table2") if "ours" in one.scores], 4)
    if not runs:
        return None

    def paint(figure: Figure) -> None:
        panels = axes_of(figure, -(-len(runs) // 2), min(2, len(runs)))
        for panel, one in zip(panels, runs, strict=False):
            frames = one.frames
            for kind, series in _volume_series(one).items():
                line(panel, one.outcome.seconds[frames], _scaled(series[frames]), kind)
            found = [(kind, one.outcome.notes.get(f"spirometer_{kind}", {})) for kind in ("plain", "ours")]
            article_value = ", ".join(
                f"{kind} {notes['correlation']:.4f}" for kind, notes in found if "correlation" in notes
            )
            caption(panel, f"{one.run.name}: correlation {article_value}", "time [s]", "volume, scaled")
        legend(panels[0])

    note = "Scaled to -1..1 as in the article, after the spirometer's lag was found. The article's correlation: 0.97."
    return draw("fig11_volume", "Figure 11: volume", note, (10, 1.2 + 2.4 * (-(-len(runs) // 2))), paint)


def _volume_series(one: ScoredRun) -> dict[str, FloatArray]:
    """Return spirometer and measured volumes of the same frames; the truth where there is no spirometer."""
    found = one.outcome.instruments
    if "spirometer_ours_l" in found:
        series = {"spirometer": found["spirometer_ours_l"]}
        return series | {kind: found[f"volume_{kind}_l"] for kind in ("plain", "ours") if f"volume_{kind}_l" in found}
    series = {"truth": one.outcome.truth.volume_l}
    return series | {kind: one.outcome.tracks[kind].volume_l for kind in ("plain", "ours") if kind in one.scores}


def motions(scored: list[ScoredRun]) -> Picture | None:
    """Figure 12: motion at one point of four datasets."""
    runs = _spread([one for one in of_group(scored, "table2") if "ours" in one.scores], 4)
    if not runs:
        return None

    def paint(figure: Figure) -> None:
        panels = axes_of(figure, len(runs), 2, share_x=False)
        for number, one in enumerate(runs):
            left, right = panels[2 * number : 2 * number + 2]
            if "laser_mm" in one.outcome.instruments:
                _laser_panels(left, right, one)
            else:
                _motion_panels(left, right, one, POINT, ("plain", "ours"))
        legend(panels[0])
        legend(panels[1])

    note = (
        "Motion at the second of five places along the laser's line, and how far each is from the laser. The laser's "
        "own error is part of it."
    )
    return draw("fig12_motion", "Figure 12: motion against the laser line", note, (10, 0.6 + 2.2 * len(runs)), paint)


def _laser_panels(left: Axes, right: Axes, one: ScoredRun) -> None:
    found, seconds = one.outcome.instruments, one.outcome.seconds
    laser, ours = found["laser_mm"][:, FIVE[1]], found["laser_ours_mm"][:, FIVE[1]]
    line(left, seconds, laser, "laser")
    line(left, seconds, ours, "ours")
    line(right, seconds, found["laser_plain_mm"][:, 1] - found["laser_line_mm"][:, 1], "plain", width=0.9)
    line(right, seconds, ours - laser, "ours", width=0.9)
    for panel, title, unit in ((left, "motion", "motion [mm]"), (right, "minus laser", "difference [mm]")):
        caption(panel, f"{one.run.name}: {title}", "time [s]", unit)
        _trim(panel, one)


def along_laser(scored: list[ScoredRun]) -> Picture | None:
    """Figure 13: correlation along the laser line, one curve per dataset."""
    curves = {one.run.name: curve for one in of_group(scored, "table2") if (curve := along_line(one)) is not None}
    if not curves:
        return None

    def paint(figure: Figure) -> None:
        panel = axes_of(figure, 1)[0]
        for number, (name, curve) in enumerate(curves.items()):
            panel.plot(100.0 * LINE_SHARES, curve, "-", color=shade_of(number, len(curves)), linewidth=1, label=name)
        panel.axhline(0.98, color=COLORS["plain"], linewidth=1, linestyle="--", label="article, mean")
        panel.set_ylim(0.95, 1.002)
        caption(panel, "", "place along the line [%]", "correlation with the laser")
        panel.legend(fontsize=7, ncols=8, frameon=False, loc="lower center")

    mean = float(np.nanmean(np.stack(list(curves.values()))))
    note = f"Mean over all places and datasets {mean:.4f}; the article's 0.98."
    return draw("fig13_correlation", "Figure 13: correlation along the laser line", note, (9, 3.6), paint)


def _motion_panels(left: Axes, right: Axes, one: ScoredRun, point: int, kinds: tuple[str, ...]) -> None:
    seconds, frames = one.outcome.seconds, one.frames
    truth = None
    for kind in kinds:
        if kind not in one.scores:
            continue
        truth = one.true_motion(kind)[1][:, point]
        motion = one.outcome.tracks[kind].points_mm[:, point]
        # Shift all curves to our reference frame: each method has its own.
        shift = (truth - one.true_motion("ours")[1][:, point])[frames][0] if "ours" in one.scores else 0.0
        line(left, seconds[frames], (motion - shift)[frames], kind)
        line(right, seconds[frames], (motion - truth)[frames], kind, width=0.9)
    if truth is not None:
        line(left, seconds[frames], one.true_motion("ours")[1][frames, point], "truth")
    caption(left, f"{one.run.name}, P{point + 1}", "time [s]", "motion [mm]")
    caption(right, f"{one.run.name}, P{point + 1}: error", "time [s]", "error [mm]")


def filters(scored: list[ScoredRun]) -> Picture | None:
    """Figure 14: the bilateral filter alone against PCA."""
    one = next((one for one in scored if "bilateral" in one.scores), None)
    if one is None:
        return None

    def paint(figure: Figure) -> None:
        panels = axes_of(figure, 1, 2)
        _motion_panels(panels[0], panels[1], one, POINT, ("bilateral", "plain", "ours"))
        start = float(one.outcome.seconds[one.frames][0])
        for panel in panels:
            panel.set_xlim(start, start + 10.0)
        legend(panels[0], 2)

    note = "Ten seconds of the same frames; bilateral: hole filling and the bilateral filter without PCA."
    return draw("fig14_bilateral", "Figure 14: bilateral filter against PCA", note, (10, 3.2), paint)


def isovolume(scored: list[ScoredRun]) -> Picture | None:
    """Figure 15: thorax against abdomen in the isovolume manoeuvre."""
    runs = [one for one in of_group(scored, "isovolume") if "ours" in one.scores]
    if not runs:
        return None

    def paint(figure: Figure) -> None:
        panels = axes_of(figure, len(runs), 1)
        for panel, one in zip(panels, runs, strict=True):
            seconds, wide, true = one.outcome.seconds, one.outcome.tracks["ours"].wide_mm, one.true_motion("ours")[0]
            names = (("whole", "#222222"), ("thorax", "#0f766e"), ("abdomen", "#c23b22"))
            for part, (name, shade) in enumerate(names):
                panel.plot(seconds[one.frames], wide[one.frames, part], color=shade, linewidth=1.2, label=name)
                panel.plot(seconds[one.frames], true[one.frames, part], ":", color=shade, linewidth=1.0)
            score = one.event_scores.get("ours", one.scores["ours"])
            article_value = f"thorax against abdomen {score.halves_correlation:.4f} in the manoeuvre"
            caption(panel, f"{one.run.name}: {article_value}", "time [s]", "motion [mm]")
        legend(panels[0], 3)

    note = "Dotted: the truth. A spirometer cannot measure this manoeuvre. The article: -0.99."
    return draw("fig15_isovolume", "Figure 15: isovolume manoeuvre", note, (10, 0.6 + 2.5 * len(runs)), paint)


def long_regular(scored: list[ScoredRun]) -> Picture | None:
    """Figure 16: long runs of regular breathing."""
    runs = [one for one in of_group(scored, "table2") if one.run.is_long]
    return _long("fig16_long_regular", "Figure 16: long runs, regular breathing", runs)


def long_irregular(scored: list[ScoredRun]) -> Picture | None:
    """Figure 17: long runs of irregular breathing."""
    runs = [one for one in of_group(scored, "irregular") if one.run.is_long]
    return _long("fig17_long_irregular", "Figure 17: long runs, irregular breathing", runs)


def _long(name: str, title: str, runs: list[ScoredRun]) -> Picture | None:
    runs = [one for one in runs if "ours" in one.scores and "plain" in one.scores]
    if not runs:
        return None

    def paint(figure: Figure) -> None:
        panels = axes_of(figure, len(runs), 2)
        for number, one in enumerate(runs):
            left, right = panels[2 * number : 2 * number + 2]
            frames, seconds = one.frames, one.outcome.seconds
            line(left, seconds[frames], one.outcome.tracks["ours"].points_mm[frames, POINT], "ours")
            line(left, seconds[frames], one.true_motion("ours")[1][frames, POINT], "truth")
            for kind, style, label in (
                ("plain1", ":", "plain, one component"),
                ("plain", "-", "plain, three"),
                ("ours1", ":", "ours, one component"),
                ("ours", "-", "ours, three"),
            ):
                if kind not in one.scores:
                    continue
                error = one.outcome.tracks[kind].points_mm - one.true_motion(kind)[1]
                shade = COLORS[kind.rstrip("1")]
                right.plot(seconds[frames], error[frames, POINT], style, color=shade, linewidth=0.9, label=label)
            caption(left, f"{one.run.name}, P{POINT + 1}", "time [s]", "motion [mm]")
            caption(right, f"{one.run.name}: error", "time [s]", "error [mm]")
        legend(panels[0], 2)
        legend(panels[1], 2)

    note = "Trained on the first part only; 52 s, the length of the article's 350 frames."
    return draw(name, title, note, (10, 0.6 + 2.6 * len(runs)), paint)


def _spread(runs: list[ScoredRun], count: int) -> list[ScoredRun]:
    """Select ``count`` runs, evenly spaced."""
    if len(runs) <= count:
        return runs
    return [runs[round(place)] for place in np.linspace(0, len(runs) - 1, count)]


def _scaled(series: FloatArray) -> FloatArray:
    low, high = float(np.nanmin(series)), float(np.nanmax(series))
    return 2.0 * (series - low) / max(high - low, 1e-9) - 1.0


def _trim(panel: Axes, one: ScoredRun) -> None:
    if one.frames.any():
        seconds = one.outcome.seconds[one.frames]
        panel.set_xlim(float(seconds[0]), float(seconds[-1]))
