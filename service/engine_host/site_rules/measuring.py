"""Convert a session's regions for the engine."""

from dataclasses import replace

from engine.core.head_direction import HeadDirection
from engine.motion.named_regions import NamedRegion
from engine.motion.settings import PipelineSettings
from service.core.schemas import sessions
from service.core.schemas.windows import Window
from service.engine_host.site_rules.window_limits import breath_signals


def measuring_with(
    settings: PipelineSettings,
    regions: sessions.Regions,
    window: Window | None = None,
    head_direction: HeadDirection | None = None,
) -> PipelineSettings:
    """Return how the pipeline measures a session: with its regions and head, and the points and breaths of its window.

    Without a head direction the pipeline assumes one: the whole region and its volume do not depend on it.
    """
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
        superior_px=settings.superior_px if head_direction is None else head_direction.superior_px,
        extra_markers=regions.extra_markers or settings.extra_markers,
    )
