"""Finds the two stickers at the costal margin during training, which fix the line between thorax and abdomen.

Owned by the pipeline's thread. Only every tenth frame is searched, since searching the whole picture takes a few
milliseconds. The line is fixed with the first model: a line that moves would change the reference of both parts.
"""

from engine.core.frames import ROI_ROWS, ColorImage, FloatArray
from engine.motion.stages.extra_markers import agreed_split, find_split
from engine.motion.stages.markers import MarkerSearch, find_stickers
from engine.motion.stages.regions import MIN_PART_ROWS
from engine.motion.stages.roi import color_from_roi

SEARCH_EVERY_FRAMES = 10


class CostalLineTracker:
    """Collects the line between thorax and abdomen that the patient's stickers mark."""

    def __init__(self) -> None:
        self._frames = 0
        self._seen: list[tuple[float, float] | None] = []

    def search(self, color: ColorImage, search: MarkerSearch, corners_px: FloatArray) -> None:
        """Search a training frame with the given four marker centres, shape (4, 2) [px]."""
        if self._frames % SEARCH_EVERY_FRAMES == 0:
            self._seen.append(find_split(find_stickers(color, search), color_from_roi(corners_px)))
        self._frames += 1

    @property
    def split(self) -> tuple[float, float] | None:
        """Rows at which the line crosses columns 0 and 199; None if too few pictures show both stickers."""
        split = agreed_split(self._seen)
        is_usable = split is not None and all(MIN_PART_ROWS <= row <= ROI_ROWS - MIN_PART_ROWS for row in split)
        return split if is_usable else None
