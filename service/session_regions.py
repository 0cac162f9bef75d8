"""What a session's regions are to the engine, and their motion on its way to rows and back."""

from dataclasses import replace

import numpy as np

from engine.frames import Motion
from engine.pipeline import PipelineSettings
from engine.polygons import NamedRegion
from service import schemas
from service.site_limits import breath_signals
from service.window_schemas import Window

NAMED_DTYPE = "<f4"
DIGITS = 5  # what single precision holds of a length in mm


def measuring_with(
    settings: PipelineSettings, regions: schemas.Regions, window: Window | None = None
) -> PipelineSettings:
    """Return how the pipeline measures a session: with its regions, and with the points and breaths of its window."""
    named = tuple(
        NamedRegion(name=region.name, vertices=tuple((row, column) for row, column in region.vertices))
        for region in regions.named
    )
    line = regions.split
    split = settings.split if line is None else (line.right_row, line.left_row)
    return replace(
        settings,
        named=named,
        split=split,
        points=settings.points if window is None else tuple(dict.fromkeys((*window.points, *settings.points))),
        breath_signals=settings.breath_signals if window is None else breath_signals(window, regions),
        extra_markers=regions.extra_markers or settings.extra_markers,
    )


def named_bytes(motion: Motion | None) -> bytes | None:
    """Put the named regions' motion [mm] into a row: float32 in their order, NaN where unknown; None for none."""
    if motion is None or len(motion.named_mm) == 0:
        return None
    return motion.named_mm.astype(NAMED_DTYPE).tobytes()


def named_values(stored: bytes | None, count: int) -> list[float | None]:
    """Read them back; None for what was not measured."""
    if stored is None:
        return [None] * count
    return [
        round(float(value), DIGITS) if np.isfinite(value) else None
        for value in np.frombuffer(stored, dtype=NAMED_DTYPE)
    ]
