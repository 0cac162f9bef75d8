"""Finds the two stickers at the costal margin during training, which fix the line between thorax and abdomen.

Owned by the pipeline's thread. Only every tenth frame is searched, since searching the whole picture takes a few
milliseconds. The line is fixed with the first model: a line that moves would change the reference of both parts.

Two stickers at the costal margin, one at each side, whose line separates thorax and abdomen.

Inputs are the sticker candidates in colour pixels and the region's map; other stages compute both. Each side needs
exactly one sticker; otherwise the picture gives no line.
"""

import numpy as np

from engine.core.frames import ROI_COLUMNS, ROI_ROWS, ColorImage, FloatArray
from engine.motion.stages.markers import MarkerSearch, find_stickers
from engine.motion.stages.regions import MIN_PART_ROWS
from engine.motion.stages.roi import color_from_roi

SIDE_PX = 35.0
MIN_FROM_END_PX = 35.0
MIN_PICTURES = 5
MIN_SHARE = 0.5
SEARCH_EVERY_FRAMES = 10


def split_between(centers_rc: FloatArray) -> tuple[float, float]:
    """Return the rows at which the line through two grid points, shape (2, 2), crosses columns 0 and 199."""
    (row, column), (other_row, other_column) = centers_rc.tolist()
    slope = (other_row - row) / (other_column - column)
    return row - slope * column, row + slope * (ROI_COLUMNS - 1 - column)


def find_split(candidates_px: FloatArray, color_from_roi: FloatArray) -> tuple[float, float] | None:
    """Find the two extra stickers in one picture.

    Parameters
    ----------
    candidates_px
        Centres of all sticker candidates [colour px], shape (n, 2).
    color_from_roi
        Homography from the region's grid (column, row) to colour pixels (x, y), shape (3, 3).

    Returns
    -------
    tuple[float, float] | None
        Rows at which their line crosses columns 0 and 199; None unless there is exactly one sticker at each side.
    """
    if len(candidates_px) == 0:
        return None
    points = np.column_stack([candidates_px, np.ones(len(candidates_px))]) @ np.linalg.inv(color_from_roi).T
    grid_rc = (points[:, :2] / points[:, 2:])[:, ::-1]
    is_between = (grid_rc[:, 0] > MIN_FROM_END_PX) & (grid_rc[:, 0] < ROI_ROWS - 1 - MIN_FROM_END_PX)
    sides = [grid_rc[is_between & (np.abs(grid_rc[:, 1] - edge) < SIDE_PX)] for edge in (0.0, ROI_COLUMNS - 1.0)]
    if any(len(side) != 1 for side in sides):
        return None
    return split_between(np.concatenate(sides))


def agreed_split(splits: list[tuple[float, float] | None]) -> tuple[float, float] | None:
    """Return the median line of several pictures; None if fewer than half of them, or fewer than five, have one."""
    found = [split for split in splits if split is not None]
    if len(found) < max(MIN_PICTURES, MIN_SHARE * len(splits)):
        return None
    right, left = np.median(np.array(found), axis=0).tolist()
    return right, left


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
