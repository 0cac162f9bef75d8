"""One picture of a calibration's residuals: arrows where corners were, and a bar a picture."""

from io import BytesIO

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from engine.calibration.procedures.boards import COLUMNS, ROWS, Coverage
from engine.calibration.procedures.checkerboard import CheckerboardResult
from engine.calibration.procedures.stereo_pair import PairFit
from engine.core.frames import FloatArray
from engine.core.geometry import Intrinsics

DPI = 110
# The longest arrows, those of all but a fiftieth, are drawn this long, in shares of the picture's width.
_ARROW_SHARE = 0.05
_COLORS = {"depth": "#0f766e", "color": "#c23b22", "alignment": "#4a5fa5"}
_NAMES = {
    "depth": "infrared corners, that camera alone",
    "color": "colour corners, that camera alone",
    "alignment": "colour corners against the depth camera",
}


def draw_residuals(result: CheckerboardResult) -> bytes:
    """Draw the residuals of both cameras and of their alignment; a PNG."""
    figure = Figure(figsize=(13.0, 8.2), dpi=DPI, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    grid = figure.add_gridspec(2, 3, height_ratios=(1.25, 1.0))
    fit = result.fit
    depth_px = np.stack([pair.depth_px for pair in fit.pairs])
    color_px = np.stack([pair.color_px for pair in fit.pairs])
    depth, color = fit.depth.intrinsics, fit.color.intrinsics
    for column, (kind, corners, residuals, camera, coverage) in enumerate(
        (
            ("depth", depth_px, fit.depth.residuals_px, depth, result.coverage["depth"]),
            ("color", color_px, fit.color.residuals_px, color, result.coverage["color"]),
            ("alignment", color_px, fit.alignment_px, color, result.coverage["color"]),
        )
    ):
        panel = figure.add_subplot(grid[0, column])
        _draw_arrows(panel, kind, corners.reshape(-1, 2), residuals.reshape(-1, 2), camera)
        _shade_empty(panel, camera, coverage)
    _draw_bars(figure.add_subplot(grid[1, :]), fit)
    accuracy = result.accuracy
    figure.suptitle(
        f"{result.calibration.camera}: depth and colour agree within {accuracy.residual_mm:.2f} mm at 850 mm "
        f"(rms of all corners), known to {accuracy.alignment_mm:.2f} mm; "
        f"{len(fit.pairs)} pictures used, {len(fit.outliers)} left out",
        fontsize=11,
    )
    out = BytesIO()
    figure.savefig(out, format="png", metadata={"Software": None})
    return out.getvalue()


def _draw_arrows(panel: Axes, kind: str, corners: FloatArray, residuals: FloatArray, camera: Intrinsics) -> None:
    lengths = np.linalg.norm(residuals, axis=1)
    longest = max(float(np.percentile(lengths, 98.0)), 1e-6)
    enlarged = residuals * (_ARROW_SHARE * camera.width / longest)
    panel.quiver(
        *corners.T, *enlarged.T, color=_COLORS[kind], angles="xy", scale_units="xy", scale=1.0, width=0.0025, alpha=0.75
    )
    panel.set_xlim(0, camera.width)
    panel.set_ylim(camera.height, 0)
    panel.set_aspect("equal")
    panel.set_title(_NAMES[kind], fontsize=10, loc="left")
    rms = float(np.sqrt(np.square(lengths).mean()))
    panel.set_xlabel(
        f"rms {rms:.3f} px; arrows {_ARROW_SHARE * camera.width / longest:.0f} times enlarged; grey: no corner ever",
        fontsize=8,
    )
    panel.tick_params(labelsize=7)


def _shade_empty(panel: Axes, camera: Intrinsics, coverage: Coverage) -> None:
    image = np.zeros((ROWS, COLUMNS, 4))
    image[..., 3] = np.where(coverage.cells, 0.0, 0.14)
    panel.imshow(image, extent=(0, camera.width, camera.height, 0), interpolation="nearest", zorder=0)


def _draw_bars(panel: Axes, fit: PairFit) -> None:
    places = np.arange(len(fit.pairs))
    for offset, (kind, errors) in zip((-0.27, 0.0, 0.27), fit.errors_px.items(), strict=True):
        panel.bar(places + offset, errors, width=0.25, color=_COLORS[kind], label=_NAMES[kind])
    panel.set_xticks(places, [pair.name[:24] for pair in fit.pairs], rotation=45, ha="right", fontsize=7)
    panel.set_ylabel("rms of a picture's corners [px]", fontsize=9)
    panel.spines[["top", "right"]].set_visible(False)
    panel.grid(visible=True, axis="y", color="#e6e6e6", linewidth=0.6)
    panel.set_axisbelow(True)
    panel.set_ylim(0, 1.45 * max(float(errors.max()) for errors in fit.errors_px.values()))
    panel.legend(fontsize=8, frameon=False, ncols=3, loc="upper right")
    if fit.outliers:
        panel.text(0.005, 0.96, _outlier_text(fit), transform=panel.transAxes, fontsize=8, va="top", color="#a00000")


def _outlier_text(fit: PairFit) -> str:
    lines = [f"{name}: {reason}" for name, reason in fit.outliers.items()]
    more = [f"and {len(lines) - 4} more"] if len(lines) > 4 else []
    return "\n".join(["left out:", *lines[:4], *more])
