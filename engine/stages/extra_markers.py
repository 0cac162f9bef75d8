"""Two more stickers at the costal margin, one at each side: the line between them parts thorax from abdomen.

What looks like a sticker comes as plain colour pixels, and so does the map of the region: finding stickers and laying
out the region are other stages. Each side takes exactly one; none or two is a picture that cannot tell.
"""

import numpy as np

from engine.frames import ROI_COLUMNS, ROI_ROWS, FloatArray

SIDE_PX = 35.0
MIN_FROM_END_PX = 35.0
MIN_PICTURES = 5
MIN_SHARE = 0.5


def split_between(centers_rc: FloatArray) -> tuple[float, float]:
    """Return where the line through two grid points (row, column), shape (2, 2), crosses column 0 and column 199."""
    (row, column), (other_row, other_column) = centers_rc.tolist()
    slope = (other_row - row) / (other_column - column)
    return row - slope * column, row + slope * (ROI_COLUMNS - 1 - column)


def find_split(candidates_px: FloatArray, color_from_roi: FloatArray) -> tuple[float, float] | None:
    """Look for the two extra stickers of one picture.

    Parameters
    ----------
    candidates_px
        Centres of everything that looks like a sticker [colour px], shape (n, 2).
    color_from_roi
        Homography from the region's grid (column, row) to colour pixels (x, y), shape (3, 3).

    Returns
    -------
    tuple[float, float] | None
        Rows where their line crosses column 0 and column 199; None unless there is one sticker at each side.
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


def agreed_split(seen: list[tuple[float, float] | None]) -> tuple[float, float] | None:
    """Settle on the median of what pictures said; None when fewer than half of them, or fewer than five, could tell."""
    told = [split for split in seen if split is not None]
    if len(told) < max(MIN_PICTURES, MIN_SHARE * len(seen)):
        return None
    right, left = np.median(np.array(told), axis=0).tolist()
    return right, left
