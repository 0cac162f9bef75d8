"""Watches for two more stickers at the costal margin while a model is learned, and then fixes where thorax ends.

Owned by the pipeline's thread. Only now and then does it look, for the whole picture takes a few milliseconds; and once
there is a model it looks no more: a line that moves would move the zero of thorax and abdomen with it.
"""

from engine.frames import ROI_ROWS, ColorImage, FloatArray
from engine.stages.extra_markers import agreed_split, find_split
from engine.stages.markers import MarkerSearch, find_stickers
from engine.stages.regions import MIN_PART_ROWS
from engine.stages.roi import color_from_roi

LOOK_EVERY_FRAMES = 10


class SplitFinder:
    """The line between thorax and abdomen, as the patient's own stickers mark it."""

    def __init__(self) -> None:
        self._frames = 0
        self._seen: list[tuple[float, float] | None] = []

    def look(self, color: ColorImage, search: MarkerSearch, corners_px: FloatArray) -> None:
        """Take a training frame with its four markers."""
        if self._frames % LOOK_EVERY_FRAMES == 0:
            self._seen.append(find_split(find_stickers(color, search), color_from_roi(corners_px)))
        self._frames += 1

    @property
    def split(self) -> tuple[float, float] | None:
        """Rows where the line crosses column 0 and 199 of the grid; None when too few pictures showed both stickers."""
        split = agreed_split(self._seen)
        is_usable = split is not None and all(MIN_PART_ROWS <= row <= ROI_ROWS - MIN_PART_ROWS for row in split)
        return split if is_usable else None
