"""Two stickers at the costal margin, one on each long side of the quadrilateral, that separate thorax and abdomen."""

import cv2
import numpy as np

from engine.core.frames import ROI_COLUMNS, ROI_ROWS, FloatArray
from engine.lab.phantom.anatomy import MODES, Anatomy
from engine.lab.phantom.rig import Rig
from engine.lab.phantom.scenarios import Pose
from engine.lab.phantom.truth import Grid, Skin, sticker_px
from engine.lab.phantom.view import Frustum

_DOWN = (0.44, 0.52)  # of the way from the superior to the inferior sticker, on the patient's right and left
_SLOPE_STEP_MM = 4.0


class CostalStickers:
    """Positions, slopes and brightness of the two stickers on the skin."""

    def __init__(self, anatomy: Anatomy) -> None:
        superior_right, superior_left, inferior_left, inferior_right = anatomy.anchors_mm
        sides = ((superior_right, inferior_right), (superior_left, inferior_left))
        places = [(1.0 - down) * top + down * bottom for down, (top, bottom) in zip(_DOWN, sides, strict=True)]
        self._x_mm, self._y_mm = np.array(places).T
        self._rest_mm = anatomy.trunk_height(self._x_mm, self._y_mm)
        self._modes = anatomy.modes(self._x_mm, self._y_mm)
        self.slopes = self._slopes(anatomy)
        self.light = 0.98 - 0.0004 * self._x_mm - 0.0002 * self._y_mm

    def centers_mm(self, weights_mm: FloatArray) -> Grid:
        """Centres (x, y, z down) in the body frame [mm], shape (2, 3)."""
        height = self._rest_mm + (self._modes * np.asarray(weights_mm)[:, None]).sum(axis=0)
        return np.column_stack([self._x_mm, self._y_mm, -height])

    def split_rows(self, rig: Rig, skin: Skin, pose: Pose) -> tuple[float, float]:
        """Rows at which the line through the two crosses columns 0 and 199 of the ROI grid, with the body at rest."""
        right, bottom = ROI_COLUMNS - 1.0, ROI_ROWS - 1.0
        corners = np.array([[0.0, 0.0], [right, 0.0], [right, bottom], [0.0, bottom]], dtype=np.float32)
        at_rest = np.zeros(MODES)
        corners_px = sticker_px(rig, skin, at_rest, pose).astype(np.float32)
        camera_from_body = Frustum(rig.color_from_couch, pose).camera_from_body
        extra_px = rig.color.project(camera_from_body.apply(self.centers_mm(at_rest)))
        grid = cv2.perspectiveTransform(extra_px[None], cv2.getPerspectiveTransform(corners_px, corners))[0]
        (column, row), (other_column, other_row) = grid.tolist()
        slope = (other_row - row) / (other_column - column)
        return row - slope * column, row + slope * (right - column)

    def _slopes(self, anatomy: Anatomy) -> Grid:
        """Mean slope of the skin under each, along x and y, shape (2, 2)."""
        x, y, step = self._x_mm, self._y_mm, _SLOPE_STEP_MM
        along_x = anatomy.trunk_height(x + step, y) - anatomy.trunk_height(x - step, y)
        along_y = anatomy.trunk_height(x, y + step) - anatomy.trunk_height(x, y - step)
        return np.asarray(np.column_stack([along_x, along_y]) / (2.0 * step))
