"""The region's colour: an object on the patient has another one than the skin or the shirt below it.

Brightness is not compared, since shadows and the camera's exposure change it; nor is a change that the whole picture
shares, which is the camera's white balance. What is too dark to have a colour has none to compare: cells that became so
dark count as changed where they darkened far more than the picture around the region, which a dark object does.
"""

from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from engine.core.compiled import FramePath
from engine.core.frames import ColorImage, FloatArray, frozen
from engine.motion.stages.roi import color_from_grid

CELL_ROWS, CELL_COLUMNS = 35, 20
_WARPED_PX = (4 * CELL_COLUMNS, 4 * CELL_ROWS)
_CORNERS_PX = np.array(
    [[0, 0], [_WARPED_PX[0] - 1, 0], [_WARPED_PX[0] - 1, _WARPED_PX[1] - 1], [0, _WARPED_PX[1] - 1]], dtype=np.float32
)
OTHER_COLOR = 0.03
"""Change of the share of red or green from which a cell has another colour; noise and breathing change it by 0.015."""
BLOCK_ROWS, BLOCK_COLUMNS = 5, 4
OTHER_BLOCK_COLOR = 0.015
"""The same for a block of cells, of which more than half have to change in the same direction; noise and breathing
change the median of a block by up to 0.006. A sheet of nearly the shirt's hue changes every cell a little."""
LEAST_BRIGHTNESS = 45.0
"""Sum of red, green and blue below which a cell's colour is noise."""
EQUAL, MOST_EQUAL = 2, 0.95
"""Channels that differ by no more are equal, as in an infrared picture that was compressed; and the share of such
pixels above which a picture has no colour."""
LEAST_DARK_CELLS = 21
"""Cells that lost their colour in the dark from which brightness is looked at: 3 % of the region."""
DARKENED = 0.4
"""A dark cell has darkened below this share of its brightness, counted against the surroundings of the region."""
AROUND = 0.4
"""The surroundings reach this share of the region's size beyond it."""
AROUND_STEP_PX = 8
_LEAST_OBJECT = np.ones((4, 4), dtype=np.uint8)
"""Four centimetres, of a region of 35 by 20 cm."""

Chroma = npt.NDArray[np.float32]
_X, _Y = np.meshgrid(4.0 * np.arange(CELL_COLUMNS) + 1.5, 4.0 * np.arange(CELL_ROWS) + 1.5)
_MIDDLES_PX = np.stack([_X.ravel(), _Y.ravel()], axis=1).astype(np.float32)


class Brightness(NamedTuple):
    """Sum of red, green and blue: at the middle of each cell, shape (700,), and the mean around the region."""

    cells: FloatArray
    around: float


DARK = Brightness(frozen(np.zeros(CELL_ROWS * CELL_COLUMNS)), 0.0)


def brightness_of(color: ColorImage, markers_px: FloatArray) -> Brightness:
    """Return the brightness of the region's cells, and of the picture around the region (0 where there is none)."""
    height, width = color.shape[:2]
    from_region = cv2.getPerspectiveTransform(_CORNERS_PX, markers_px.astype(np.float32))
    places = np.rint(cv2.perspectiveTransform(_MIDDLES_PX[None], from_region)[0]).astype(np.intp)
    columns, rows = np.clip(places[:, 0], 0, width - 1), np.clip(places[:, 1], 0, height - 1)
    cells = color[rows, columns].sum(axis=1, dtype=np.float64)
    (left, top), (right, bottom) = markers_px.min(axis=0), markers_px.max(axis=0)
    x, y = np.arange(0, width, AROUND_STEP_PX), np.arange(0, height, AROUND_STEP_PX)
    beside, above = AROUND * (right - left), AROUND * (bottom - top)
    is_near = np.outer((y >= top - above) & (y <= bottom + above), (x >= left - beside) & (x <= right + beside))
    is_around = is_near & ~np.outer((y >= top) & (y <= bottom), (x >= left) & (x <= right))
    samples = color[::AROUND_STEP_PX, ::AROUND_STEP_PX][is_around]
    return Brightness(cells, float(samples.sum(axis=1, dtype=np.float64).mean()) if len(samples) else 0.0)


def darkened_share(before: Chroma, now: Chroma, was: Brightness, is_now: Brightness) -> float:
    """Return the share of the region that became dark while its surroundings stayed brighter, 0 to 1."""
    usual = was.cells * (is_now.around / was.around if was.around > 0.0 else 1.0)
    has_lost = np.isnan(now[:, 0]) & np.isfinite(before[:, 0])
    is_darkened = (has_lost & (is_now.cells < DARKENED * usual)).reshape(CELL_ROWS, CELL_COLUMNS)
    objects = cv2.morphologyEx(is_darkened.astype(np.uint8), cv2.MORPH_OPEN, _LEAST_OBJECT)
    return float(np.count_nonzero(objects)) / objects.size


def chroma_of(color: ColorImage, markers_px: FloatArray, thin: ColorImage) -> Chroma:
    """Return red and green as shares of brightness, at each cell of the region, shape (700, 2); NaN where dark.

    What the whole picture, by its thinned view, shares with others of its kind is subtracted. An infrared picture has
    no colour anywhere.
    """
    if _is_gray(thin):
        return np.full((CELL_ROWS * CELL_COLUMNS, 2), np.nan, dtype=np.float32)
    compiled = FramePath.kernels
    if compiled is None:
        return _chroma_of(color, markers_px.astype(np.float32), thin)
    chroma = np.empty((CELL_ROWS * CELL_COLUMNS, 2), dtype=np.float32)
    from_region = color_from_grid(markers_px, _WARPED_PX[0] - 1.0, _WARPED_PX[1] - 1.0)
    compiled.sample_chroma(
        np.ascontiguousarray(color), from_region, CELL_COLUMNS, np.ascontiguousarray(thin), LEAST_BRIGHTNESS, chroma
    )
    return chroma


def _is_gray(thin: ColorImage) -> bool:
    """Whether the channels are equal nearly everywhere."""
    compiled = FramePath.kernels
    if compiled is not None:
        return bool(compiled.is_gray(np.ascontiguousarray(thin), EQUAL, MOST_EQUAL))
    return float((thin.max(axis=2) - thin.min(axis=2) <= EQUAL).mean()) > MOST_EQUAL


def _chroma_of(color: ColorImage, corners_px: FloatArray, thin: ColorImage) -> Chroma:
    """Return the same with OpenCV."""
    to_region = cv2.getPerspectiveTransform(corners_px, _CORNERS_PX)
    warped = cv2.warpPerspective(color, to_region, _WARPED_PX, flags=cv2.INTER_NEAREST)  # averaged below
    cells = cv2.resize(warped, (CELL_COLUMNS, CELL_ROWS), interpolation=cv2.INTER_AREA)
    picture = _shares(thin)
    bright = picture[np.isfinite(picture[:, 0])]
    balance = np.median(bright, axis=0) if len(bright) else np.zeros(2, dtype=np.float32)
    return np.asarray(_shares(np.asarray(cells, dtype=np.uint8)) - balance, dtype=np.float32)


class ColorChange(NamedTuple):
    """What has become of the region's colour.

    Attributes
    ----------
    changed_share
        Share of the region that has another colour than before, 0 to 1; lines are left out, since a positioning laser
        that wanders over the skin is no object.
    colored_share
        Share that has a colour, now and before: the rest cannot be compared.
    dark_cells
        Number of cells that had a colour and are too dark for one now.
    """

    changed_share: float
    colored_share: float
    dark_cells: int


def color_change(before: Chroma, now: Chroma, newest: Chroma) -> ColorChange:
    """Compare colours.

    ``newest`` takes the present colour; a cell that is dark now keeps the colour it was last seen in.
    """
    compiled = FramePath.kernels
    if compiled is not None:
        changed, colored, dark = compiled.changed_cells(
            before,
            now,
            newest,
            CELL_COLUMNS,
            len(_LEAST_OBJECT),
            OTHER_COLOR,
            BLOCK_ROWS,
            BLOCK_COLUMNS,
            OTHER_BLOCK_COLOR,
        )
        return ColorChange(changed / len(before), colored / len(before), dark)
    had_color, has_color = np.isfinite(before[:, 0]), np.isfinite(now[:, 0])
    np.copyto(newest, now, where=np.isfinite(now))
    change = (newest - before).reshape(CELL_ROWS, CELL_COLUMNS, 2)
    is_changed = (np.abs(change).max(axis=2) > OTHER_COLOR) | _are_in_changed_blocks(change)
    objects = cv2.morphologyEx(is_changed.astype(np.uint8), cv2.MORPH_OPEN, _LEAST_OBJECT)
    return ColorChange(
        changed_share=float(np.count_nonzero(objects)) / objects.size,
        colored_share=float(np.count_nonzero(had_color & has_color)) / len(before),
        dark_cells=int(np.count_nonzero(had_color & ~has_color)),
    )


def _are_in_changed_blocks(change: Chroma) -> npt.NDArray[np.bool_]:
    """Return which cells lie in a block that changed as a whole, shape (35, 20); an unknown cell has not changed."""
    blocks = change.reshape(CELL_ROWS // BLOCK_ROWS, BLOCK_ROWS, CELL_COLUMNS // BLOCK_COLUMNS, BLOCK_COLUMNS, 2)
    limit = np.float32(OTHER_BLOCK_COLOR)
    counts = np.maximum((blocks > limit).sum(axis=(1, 3)), (blocks < -limit).sum(axis=(1, 3))).max(axis=2)
    are_changed = counts > BLOCK_ROWS * BLOCK_COLUMNS // 2
    return np.repeat(np.repeat(are_changed, BLOCK_ROWS, axis=0), BLOCK_COLUMNS, axis=1)


def _shares(color: ColorImage) -> Chroma:
    flat = color.reshape(-1, 3).astype(np.float32)
    brightness = flat.sum(axis=1, keepdims=True)
    shares = flat[:, :2] / np.maximum(brightness, 1.0)
    return np.where(brightness >= LEAST_BRIGHTNESS, shares, np.float32(np.nan))
