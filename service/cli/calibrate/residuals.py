"""One picture of a calibration's residuals: arrows where corners were, and a bar a picture."""

from typing import Any

import numpy as np

from engine.calibration.procedures import CheckerboardResult
from engine.core.frames import FloatArray
from engine.core.geometry import Intrinsics
from service.core.typeset import typeset

ARROW_SHARE = 0.05
"""The longest arrows, those of all but a fiftieth, are drawn this long, in shares of the picture's width."""
MOST_OUTLIERS = 4
NAMES = {
    "depth": "infrared corners, that camera alone",
    "color": "colour corners, that camera alone",
    "alignment": "colour corners against the depth camera",
}
COLORS = {"depth": "#0f766e", "color": "#c23b22", "alignment": "#4a5fa5"}


def draw_residuals(result: CheckerboardResult) -> bytes:
    """Draw the residuals of both cameras and of their alignment; a PNG."""
    fit, accuracy = result.fit, result.accuracy
    depth_px = np.stack([pair.depth_px for pair in fit.pairs])
    color_px = np.stack([pair.color_px for pair in fit.pairs])
    depth, color = fit.depth.intrinsics, fit.color.intrinsics
    panels = [
        _panel(kind, corners.reshape(-1, 2), residuals.reshape(-1, 2), camera)
        | {"empty": np.argwhere(~result.coverage["depth" if kind == "depth" else "color"].cells).tolist()}
        for kind, corners, residuals, camera in (
            ("depth", depth_px, fit.depth.residuals_px, depth),
            ("color", color_px, fit.color.residuals_px, color),
            ("alignment", color_px, fit.alignment_px, color),
        )
    ]
    outliers = [f"{name}: {reason}" for name, reason in fit.outliers.items()]
    more = [f"and {len(outliers) - MOST_OUTLIERS} more"] if len(outliers) > MOST_OUTLIERS else []
    document = {
        "title": f"{result.calibration.camera}: depth and colour agree within {accuracy.residual_mm:.2f} mm at 850 mm "
        f"(rms of all corners), known to {accuracy.alignment_mm:.2f} mm; "
        f"{len(fit.pairs)} pictures used, {len(fit.outliers)} left out",
        "cells": result.coverage["depth"].cells.shape,
        "panels": panels,
        "pictures": [pair.name[:24] for pair in fit.pairs],
        "errors": {kind: np.asarray(errors).round(4).tolist() for kind, errors in fit.errors_px.items()},
        "names": NAMES,
        "colors": COLORS,
        "outliers": ["left out:", *outliers[:MOST_OUTLIERS], *more] if outliers else [],
    }
    return typeset("service.cli.calibrate", "residuals.typ", document, form="png")


def _panel(kind: str, corners: FloatArray, residuals: FloatArray, camera: Intrinsics) -> dict[str, Any]:
    lengths = np.linalg.norm(residuals, axis=1)
    enlarged = ARROW_SHARE * camera.width / max(float(np.percentile(lengths, 98.0)), 1e-6)
    size = np.array([camera.width, camera.height])
    arrows = np.concatenate([corners / size, (corners + residuals * enlarged) / size], axis=1)
    rms = float(np.sqrt(np.square(lengths).mean()))
    return {
        "kind": kind,
        "size": size.tolist(),
        "arrows": arrows.round(5).tolist(),
        "words": f"rms {rms:.3f} px; arrows {enlarged:.0f} times enlarged; grey: no corner ever",
    }
