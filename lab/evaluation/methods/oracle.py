"""The oracle: the error that the sensor's noise leaves if everything else is known.

Given are the body's true motion (the spatial modes of noise-free depth fields), the true marker positions and depth,
the depth of each reading before rounding to whole millimetres, and the sensor's constant misfit on this skin (learned
from the frames before the measurement, with the truth). Unknown are only the modes' weights in each frame: least
squares over the pixels with a reading, each weight shrunk according to its error. A method that has to learn the modes
can hardly have a smaller error, unless it averages over time.

The grid is the ROI's, sampled every second row and column; depth is z in the depth camera's frame [mm].
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt
from scipy.interpolate import RectBivariateSpline

from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, DepthImage, FloatArray
from lab.evaluation.methods.outcome import cell_means
from lab.phantom.rig import STEPS_A_MM
from lab.phantom.scene import Scene
from lab.phantom.sensor import depth_table_mm, shift_of

Grid = npt.NDArray[np.float64]
FIELD_STEP = 5
SAMPLE_STEP = 2
FIELDS = 48
MODE_RMS_MM = 0.01
MAX_MODES = 16
MIN_MISFIT_FRAMES = 20
OUTLIER_SHARE = 6.0

_CORNERS = np.array(
    [[0, 0], [ROI_COLUMNS - 1, 0], [ROI_COLUMNS - 1, ROI_ROWS - 1], [0, ROI_ROWS - 1]], dtype=np.float32
)
_SAMPLES_RC = np.stack(
    np.meshgrid(np.arange(0, ROI_ROWS, SAMPLE_STEP), np.arange(0, ROI_COLUMNS, SAMPLE_STEP), indexing="ij"), axis=-1
).reshape(-1, 2)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TrueModes:
    """True variation of the ROI's depth: mean surface and modes on the whole grid [mm].

    Attributes
    ----------
    mean_mm, modes
        Shapes (350, 200) and (k, 350, 200); the modes are orthonormal.
    variances_mm2
        Variance of each mode's weight over the recording, shape (k,).
    left_rms_mm
        Root mean square of the noise-free fields that the modes do not explain.
    """

    mean_mm: FloatArray
    modes: FloatArray
    variances_mm2: FloatArray
    left_rms_mm: float


def true_modes(scene: Scene, times_s: FloatArray) -> TrueModes:
    """Compute the modes from noise-free depth fields at ``times_s`` of a recording."""
    rows, columns = _field_axes()
    grid = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1).reshape(-1, 2)
    fields = np.stack([scene.roi_truth(float(t)).depth(grid, scene.breathing.weights(float(t))) for t in times_s])
    mean = fields.mean(axis=0)
    _, sizes, shapes = np.linalg.svd(fields - mean, full_matrices=False)
    left = np.sqrt(np.maximum((sizes**2).sum() - np.cumsum(sizes**2), 0.0) / fields.size)
    count = min(int(np.searchsorted(-left, -MODE_RMS_MM)) + 1, MAX_MODES, len(sizes))
    full = np.stack([_on_whole_grid(field, rows, columns) for field in (mean, *shapes[:count])])
    orthonormal = np.linalg.qr(full[1:].reshape(count, -1).T)[0].T.reshape(count, ROI_ROWS, ROI_COLUMNS)
    # Up to here the weights refer to the coarser grid of the fields.
    variances = sizes[:count] ** 2 / len(times_s) * (full[0].size / mean.size)
    return TrueModes(mean_mm=full[0], modes=orthonormal, variances_mm2=variances, left_rms_mm=float(left[count - 1]))


def _field_axes() -> tuple[Grid, Grid]:
    """Rows and columns of the field's nodes, including the last of each."""
    return np.append(np.arange(0.0, ROI_ROWS - 1, FIELD_STEP), ROI_ROWS - 1.0), np.append(
        np.arange(0.0, ROI_COLUMNS - 1, FIELD_STEP), ROI_COLUMNS - 1.0
    )


def _on_whole_grid(values: FloatArray, rows: Grid, columns: Grid) -> Grid:
    spline = RectBivariateSpline(rows, columns, values.reshape(len(rows), len(columns)))
    return np.asarray(spline(np.arange(ROI_ROWS), np.arange(ROI_COLUMNS)))


class Oracle:
    """Fits the true modes to noisy frames."""

    def __init__(self, scene: Scene, modes: TrueModes) -> None:
        self._scene = scene
        self.modes = modes
        sampled = (slice(None, None, SAMPLE_STEP), slice(None, None, SAMPLE_STEP))
        self._mean = np.ascontiguousarray(modes.mean_mm[sampled], dtype=np.float32).ravel()
        self._shapes = np.ascontiguousarray(modes.modes[:, *sampled].reshape(len(modes.modes), -1), dtype=np.float32)
        self._exact_mm = _exact_depths_mm()
        self._misfit_sum = np.zeros(self._mean.shape)
        self._misfit_count = np.zeros(self._mean.shape)
        self._fit_errors: list[FloatArray] = []

    def calibrate(self, depth_mm: DepthImage, markers_px: FloatArray, true_cells_mm: FloatArray) -> None:
        """Learn the sensor's constant misfit and the weights' errors from a frame with known truth."""
        true = self._weights_of(true_cells_mm)
        read, is_read = self._sample(depth_mm, markers_px, true)
        fitted = self._fit(read, is_read)
        if fitted is not None:
            self._fit_errors.append(fitted - true)
        self._misfit_sum += np.where(is_read, read - self._mean - true.astype(np.float32) @ self._shapes, 0.0)
        self._misfit_count += is_read

    def measure(self, depth_mm: DepthImage, markers_px: FloatArray, true_cells_mm: FloatArray) -> Grid | None:
        """Return the surface fitted to a noisy frame, shape (350, 200) [mm]; None where too few pixels have a reading.

        The truth is used only for the position of each grid point in the depth picture (0.02 px/mm), not for its depth.
        """
        read, is_read = self._sample(depth_mm, markers_px, self._weights_of(true_cells_mm))
        fitted = self._fit(read, is_read)
        if fitted is None:
            return None
        return np.asarray(self.modes.mean_mm + np.tensordot(self._shrunk(fitted), self.modes.modes, axes=1))

    def _fit(self, read: npt.NDArray[np.float32], is_read: BoolArray) -> FloatArray | None:
        """Least squares over the pixels with a reading, repeated without outliers (the sensor's jumps)."""
        usable = is_read & (self._misfit_count >= MIN_MISFIT_FRAMES)
        if int(usable.sum()) < 50 * len(self._shapes):
            return None
        still = (self._misfit_sum / np.maximum(self._misfit_count, 1.0)).astype(np.float32)
        shapes, gap = self._shapes[:, usable], (read - self._mean - still)[usable]
        weights = _least_squares(shapes, gap)
        misfit = np.abs(gap - weights.astype(np.float32) @ shapes)
        near = misfit <= OUTLIER_SHARE * np.median(misfit)
        return _least_squares(shapes[:, near], gap[near])

    def _shrunk(self, weights: FloatArray) -> FloatArray:
        """Shrink the weights by their known errors and variances: the best linear estimate."""
        if len(self._fit_errors) < len(weights) + MIN_MISFIT_FRAMES:
            return weights
        errors = np.stack(self._fit_errors)
        true = np.diag(self.modes.variances_mm2)
        share = np.linalg.solve(true + np.cov(errors, rowvar=False).reshape(true.shape), true)
        return np.asarray((weights - errors.mean(axis=0)) @ share)

    def _weights_of(self, cells_mm: FloatArray) -> FloatArray:
        """Return the modes' weights of a frame's true cell means, shape (k,)."""
        cells = cell_means(self.modes.modes).reshape(len(self.modes.modes), -1)
        gap = (cells_mm - cell_means(self.modes.mean_mm)).ravel()
        return np.asarray(np.linalg.lstsq(cells.T, gap, rcond=None)[0])

    def _sample(
        self, depth_mm: DepthImage, markers_px: FloatArray, weights: FloatArray
    ) -> tuple[npt.NDArray[np.float32], BoolArray]:
        """Read the depth at the grid points' true positions [mm], and where there is a reading, shape (s,)."""
        rig = self._scene.rig
        homography = cv2.getPerspectiveTransform(_CORNERS, markers_px.astype(np.float32))
        on_grid = _SAMPLES_RC[:, ::-1].astype(np.float64)
        points = on_grid @ homography[:, :2].T + homography[:, 2]
        x, y = self._scene.color_rays.at(points[:, :2] / points[:, 2:])
        depth = (self._mean + weights.astype(np.float32) @ self._shapes).astype(np.float64)
        back = rig.color_from_depth.inverse
        direction = np.column_stack([x, y, np.ones_like(x)]) @ back.rotation.T
        along = (depth - back.translation_mm[2]) / direction[:, 2]
        pixels = rig.depth.project(along[:, None] * direction + back.translation_mm).astype(np.float32)
        shape = (ROI_ROWS // SAMPLE_STEP, ROI_COLUMNS // SAMPLE_STEP)
        picture = self._exact_mm[depth_mm]
        read = cv2.remap(
            picture,
            pixels[:, 0].reshape(shape),
            pixels[:, 1].reshape(shape),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_CONSTANT,
            borderValue=(np.nan,),
        ).ravel()
        correction = rig.calibration.depth_correction
        if correction is not None:
            read = read * np.float32(correction.scale) + np.float32(correction.offset_mm)
        is_read = np.isfinite(read)
        return np.where(is_read, read, np.float32(0.0)), is_read


def _least_squares(shapes: FloatArray, gap: FloatArray) -> FloatArray:
    normal = (shapes @ shapes.T).astype(np.float64)
    return np.asarray(np.linalg.solve(normal, (shapes @ gap).astype(np.float64)))


def _exact_depths_mm() -> npt.NDArray[np.float32]:
    """Depth of each reading before rounding to whole millimetres, shape (65536,); NaN where no shift gives it."""
    readings = depth_table_mm()
    shifts = np.flatnonzero(readings)
    far_shift = float(shift_of(np.array(np.inf)))
    exact = np.full(np.iinfo(np.uint16).max + 1, np.nan)
    counts = np.bincount(readings[shifts], minlength=len(exact))
    sums = np.bincount(readings[shifts], weights=STEPS_A_MM / (far_shift - shifts), minlength=len(exact))
    known = counts > 0
    exact[known] = sums[known] / counts[known]
    return exact.astype(np.float32)
