"""Two stickers at the costal margin, one at each side, whose line separates thorax and abdomen.

Inputs are the sticker candidates in colour pixels and the region's map; other stages compute both. Each side needs
exactly one sticker; otherwise the picture gives no line.
"""

import numpy as np

from engine.core.frames import ROI_COLUMNS, ROI_ROWS, FloatArray

SIDE_PX = 35.0
MIN_FROM_END_PX = 35.0
MIN_PICTURES = 5
MIN_SHARE = 0.5


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
