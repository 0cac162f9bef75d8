"""The plain method: a literal implementation of the article with OpenCV, the baseline of the comparison.

Every step of sections 4.2 to 4.4 is here once, vectorised, with constants suited to an Xtion at 85 cm, and without the
engine's additions (no masks, no robust weights, no tracking, no smoothing of the reference). Where the article leaves a
step open, the usual choice is made: holes that the mode filter leaves take the pixel's mean. No code is shared with the
engine's stages.

Depth is z in the depth camera's frame [mm], 0 where there is no reading, as in the article.

The plain method's volume: mesh of region midpoints, prisms of three tetrahedra each (article, equation 8).
"""

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from engine.calibration.camera_calibration import Calibration
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, ColorImage, DepthImage, FloatArray, RgbdFrame

TRAINING_FRAMES = 100
ARTICLE_FPS = 6.7
COMPONENTS = 3
DOT_AREA_PX = (30.0, 600.0)
DOT_LENGTHINESS = 1.8
DOT_FILLING = 0.15
DOT_CANDIDATES = 12
MODE_REACH = 2
MODE_NEIGHBOURS = 12
MODE_PASSES = 5
BILATERAL_DIAMETER = 9
BILATERAL_RANGE_MM = 10.0
BILATERAL_SPACE_PX = 4.0

Grid = npt.NDArray[np.float32]
_CORNERS = np.array(
    [[0, 0], [ROI_COLUMNS - 1, 0], [ROI_COLUMNS - 1, ROI_ROWS - 1], [0, ROI_ROWS - 1]], dtype=np.float32
)
REGION_PX = 25
MM3_PER_L = 1e6
_ROWS, _COLUMNS = ROI_ROWS // REGION_PX, ROI_COLUMNS // REGION_PX


class Aligner:
    """Registers whole depth pictures to the colour picture, pixel by pixel (section 4.2)."""

    def __init__(self, calibration: Calibration) -> None:
        depth, color, pose = calibration.depth, calibration.color, calibration.color_from_depth
        columns, rows = np.meshgrid(np.arange(depth.width), np.arange(depth.height))
        pixels = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
        self._rays = (depth.rays(pixels) @ pose.rotation.T).astype(np.float32)
        self._shift_mm = pose.translation_mm.astype(np.float32)
        self._focal = (color.fx, color.fy, color.cx, color.cy)
        self._distortion = color.distortion
        self._size = (color.height, color.width)
        correction = calibration.depth_correction
        self._scale, self._offset_mm = (1.0, 0.0) if correction is None else (correction.scale, correction.offset_mm)

    def align(self, depth_mm: DepthImage) -> Grid:
        """Return the depth of each colour pixel [mm], shape (H', W'), 0 where none; the nearest reading wins."""
        seen = np.flatnonzero(depth_mm)
        seen = seen[np.argsort(depth_mm.ravel()[seen], kind="stable")[::-1]]  # the nearest is written last
        depth = depth_mm.ravel()[seen] * np.float32(self._scale) + np.float32(self._offset_mm)
        points = self._rays[seen] * depth[:, None] + self._shift_mm
        column, row = self._project(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2])
        height, width = self._size
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        aligned = np.zeros(height * width, np.float32)
        aligned[(row * width + column)[inside]] = depth[inside]
        return aligned.reshape(self._size)

    def _project(self, x: Grid, y: Grid) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        k1, k2, p1, p2, k3 = self._distortion
        fx, fy, cx, cy = self._focal
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        u = fx * (x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)) + cx
        v = fy * (y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y) + cy
        return np.rint(u).astype(np.int32), np.rint(v).astype(np.int32)


def find_dots(color: ColorImage, before_px: FloatArray | None) -> FloatArray | None:
    """Find the four markers: Otsu's threshold, contours, an ellipse per contour; None if fewer than four are found.

    Returns the centres [px], shape (4, 2), clockwise from the top left. Of more than four candidates, those nearest to
    the previous frame's are taken; in the first frame, the four that are most nearly a rectangle.
    """
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    _, binary = cv2.threshold(gray, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    contours, _ = cv2.findContours(binary, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    dots = [center for contour in contours if (center := _dot(np.asarray(contour))) is not None]
    if len(dots) < 4:
        return None
    centers = np.array(dots)
    if before_px is not None:
        gaps = np.linalg.norm(before_px[:, None] - centers[None], axis=2)
        return np.asarray(centers[gaps.argmin(axis=1)])
    fours = [_clockwise(centers[list(four)]) for four in itertools.combinations(range(len(dots[:DOT_CANDIDATES])), 4)]
    return min(fours, key=_skewness)


def _dot(contour: npt.NDArray[np.int32]) -> FloatArray | None:
    area = cv2.contourArea(contour)
    if len(contour) < 5 or not DOT_AREA_PX[0] <= area <= DOT_AREA_PX[1]:
        return None
    center, axes, _ = cv2.fitEllipse(contour)
    short, long = sorted(axes)
    if short <= 0.0 or long > DOT_LENGTHINESS * short:
        return None
    # The contour runs through the centres of the outermost pixels, half a pixel inside the dot.
    filling = area / (0.25 * np.pi * short * long)
    return np.array(center, dtype=np.float64) if abs(filling - 1.0) < DOT_FILLING else None


def _clockwise(centers_px: FloatArray) -> FloatArray:
    by_row = centers_px[np.argsort(centers_px[:, 1], kind="stable")]
    top, bottom = (pair[np.argsort(pair[:, 0], kind="stable")] for pair in (by_row[:2], by_row[2:]))
    return np.array([top[0], top[1], bottom[1], bottom[0]])


def _skewness(corners_px: FloatArray) -> float:
    top, right, bottom, left = np.linalg.norm(np.roll(corners_px, -1, axis=0) - corners_px, axis=1)
    diagonals = np.linalg.norm(corners_px[:2] - corners_px[2:], axis=1)
    pairs = ((top, bottom), (left, right), (diagonals[0], diagonals[1]))
    return float(sum(abs(a - b) / max(a, b, 1.0) for a, b in pairs)) + (1.0 if left + right < top + bottom else 0.0)


def cut_roi(aligned_mm: Grid, dots_px: FloatArray) -> Grid:
    """Map the markers' quadrilateral to the ROI grid of 350 rows by 200 columns [mm], 0 where there is no reading."""
    homography = cv2.getPerspectiveTransform(dots_px.astype(np.float32), _CORNERS)
    # Nearest neighbour: interpolating between a reading and a hole would invent depth.
    return np.asarray(cv2.warpPerspective(aligned_mm, homography, (ROI_COLUMNS, ROI_ROWS), flags=cv2.INTER_NEAREST))


def fill_zeros(depth_mm: Grid) -> Grid:
    """Zero-elimination mode filter (section 4.3.1): a zero takes the mode of enough non-zero neighbours."""
    filled = depth_mm.copy()
    span = 2 * MODE_REACH + 1
    for _ in range(MODE_PASSES):
        rows, columns = np.nonzero(filled == 0)
        padded = np.pad(np.rint(filled).astype(np.int32), MODE_REACH)
        around = np.stack([padded[rows + i, columns + j] for i in range(span) for j in range(span)], axis=1)
        enough = np.count_nonzero(around, axis=1) >= MODE_NEIGHBOURS
        if not enough.any():
            break
        filled[rows[enough], columns[enough]] = _modes(around[enough])
    return filled


def _modes(values: npt.NDArray[np.int32]) -> Grid:
    counts = (values[:, :, None] == values[:, None, :]).sum(axis=2)
    counts[values == 0] = 0
    modes: Grid = values[np.arange(len(values)), counts.argmax(axis=1)].astype(np.float32)
    return modes


def smooth(depth_mm: Grid) -> Grid:
    """Apply the edge-preserving bilateral filter (section 4.3.1)."""
    return np.asarray(cv2.bilateralFilter(depth_mm, BILATERAL_DIAMETER, BILATERAL_RANGE_MM, BILATERAL_SPACE_PX))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlainModel:
    """A motion model of equations 1 to 5.

    Attributes
    ----------
    mean_mm
        Mean frame, shape (70000,).
    components
        W, one component a row, shape (k, 70000).
    eigenvalues_mm2
        All eigenvalues, descending, shape (n,).
    """

    mean_mm: Grid
    components: Grid
    eigenvalues_mm2: FloatArray

    def project(self, roi_mm: Grid) -> FloatArray:
        """Project a frame (equation 6), shape (k,); a hole takes the mean's depth."""
        frame = roi_mm.ravel()
        return np.asarray(self.components @ np.where(frame == 0, np.float32(0.0), frame - self.mean_mm))

    def reconstruct(self, beta: FloatArray, components: int = COMPONENTS) -> Grid:
        """Reconstruct a surface (equation 7) [mm], shape (350, 200)."""
        surface = self.mean_mm + beta[:components].astype(np.float32) @ self.components[:components]
        return np.asarray(surface.reshape(ROI_ROWS, ROI_COLUMNS), dtype=np.float32)


def learn(frames_mm: list[Grid], components: int = COMPONENTS) -> PlainModel:
    """Fit a model to frames, shape (350, 200) each; remaining zeros take the mean of the pixel's readings."""
    data = np.stack([frame.ravel() for frame in frames_mm])
    read = data != 0
    counts = read.sum(axis=0)
    pixel_mean = data.sum(axis=0, dtype=np.float64) / np.maximum(counts, 1)
    pixel_mean[counts == 0] = np.median(pixel_mean[counts > 0]) if (counts > 0).any() else 0.0
    data = np.where(read, data, pixel_mean.astype(np.float32))
    return principal_components(data, components)


def principal_components(data: Grid, components: int = COMPONENTS) -> PlainModel:
    """Equations 2 to 5 on the rows of ``data``, shape (n, 70000); equation 3 must subtract the *mean*, a misprint."""
    mean = data.mean(axis=0, dtype=np.float64).astype(np.float32)
    centred = data - mean
    covariance = (centred @ centred.T).astype(np.float64) / (len(data) - 1)
    eigenvalues, vectors = np.linalg.eigh(covariance)
    largest = vectors[:, ::-1][:, :components].T.astype(np.float32) @ centred
    largest /= np.maximum(np.linalg.norm(largest, axis=1, keepdims=True), 1e-9)
    return PlainModel(mean_mm=mean, components=largest, eigenvalues_mm2=np.maximum(eigenvalues[::-1], 0.0))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class PlainFrame:
    """One measured frame: the raw ROI [mm], the coefficients, and the marker centres [px]."""

    roi_mm: Grid
    beta: FloatArray
    dots_px: FloatArray


class PlainReading:
    """The whole plain method: trains on its first hundred frames, then measures every frame.

    A hundred frames are 15 s at the article's 6.7 frames/s; at a higher rate the training frames are thinned to span
    the same time.
    """

    def __init__(self, calibration: Calibration, fps: float, *, training_frames: int = TRAINING_FRAMES) -> None:
        self._aligner = Aligner(calibration)
        self._stride = max(1, round(fps / ARTICLE_FPS))
        self._training_frames = training_frames
        self._dots: FloatArray | None = None
        self._frames = 0
        self.raw_mm: list[Grid] = []
        self.model: PlainModel | None = None

    def measure(self, frame: RgbdFrame) -> PlainFrame | None:
        """Measure the next frame; None during training and until the markers are found."""
        found = find_dots(frame.color, self._dots)
        self._dots = self._dots if found is None else found
        if self._dots is None:
            return None
        roi = cut_roi(self._aligner.align(frame.depth_mm), self._dots)
        if self.model is None:
            if self._frames % self._stride == 0:
                if len(self.raw_mm) < self._training_frames:
                    self.raw_mm.append(roi)
                else:
                    self.model = learn([smooth(fill_zeros(raw)) for raw in self.raw_mm])
            self._frames += 1
        if self.model is None:
            return None
        return PlainFrame(roi_mm=roi, beta=self.model.project(roi), dots_px=self._dots)


def unfiltered(frames_mm: list[Grid]) -> PlainModel:
    """Fit a model to unfiltered frames with their zeros (article, Figures 4b and 8b)."""
    return principal_components(np.stack([frame.ravel() for frame in frames_mm]))


class PlainVolume:
    """Volume between the surface and the plane at the deepest midpoint of the first frame."""

    def __init__(self, calibration: Calibration) -> None:
        self._camera = calibration.color
        columns, rows = np.meshgrid(np.arange(_COLUMNS), np.arange(_ROWS))
        middles = np.stack([columns, rows], axis=-1).reshape(-1, 1, 2) * REGION_PX + 0.5 * (REGION_PX - 1)
        self._middles = middles.astype(np.float32)
        self._triangles = _triangles()
        self._plane_mm: float | None = None
        self._first_l = 0.0

    def above_first_l(self, surface_mm: FloatArray, dots_px: FloatArray) -> float:
        """Volume of a surface, shape (350, 200) [mm], relative to the first one [l]; positive is inhale."""
        corners = np.array(
            [[0, 0], [ROI_COLUMNS - 1, 0], [ROI_COLUMNS - 1, ROI_ROWS - 1], [0, ROI_ROWS - 1]], dtype=np.float32
        )
        homography = cv2.getPerspectiveTransform(corners, dots_px.astype(np.float32))
        pixels = cv2.perspectiveTransform(self._middles, homography).reshape(-1, 2)
        depth = surface_mm.reshape(_ROWS, REGION_PX, _COLUMNS, REGION_PX).mean(axis=(1, 3)).ravel()
        points = self._camera.rays(np.asarray(pixels, dtype=np.float64)) * depth[:, None]
        if self._plane_mm is None:
            self._plane_mm = float(depth.max())
            self._first_l = prism_volume_l(points[self._triangles], self._plane_mm)
        return prism_volume_l(points[self._triangles], self._plane_mm) - self._first_l


def prism_volume_l(corners_mm: FloatArray, plane_mm: float) -> float:
    """Sum the prisms between triangles, shape (t, 3, 3), and their projections on the plane z = ``plane_mm`` [l]."""
    shadow = corners_mm.copy()
    shadow[:, :, 2] = plane_mm
    a, b, c = (corners_mm[:, i] for i in range(3))
    a0, b0, c0 = (shadow[:, i] for i in range(3))
    tetrahedra = np.concatenate([np.stack(four, axis=2) for four in ((a, b, c, a0), (b, c, a0, b0), (c, a0, b0, c0))])
    # Equation 8: a row of ones below the coordinates. The sign follows from the winding of the triangles.
    matrices = np.concatenate([tetrahedra, np.ones((len(tetrahedra), 1, 4))], axis=1)
    return -float(np.linalg.det(matrices).sum()) / 6.0 / MM3_PER_L


def _triangles() -> npt.NDArray[np.intp]:
    vertex = np.arange(_ROWS * _COLUMNS).reshape(_ROWS, _COLUMNS)
    corner, right, below, across = vertex[:-1, :-1], vertex[:-1, 1:], vertex[1:, :-1], vertex[1:, 1:]
    halves = (np.stack([corner, right, across], axis=-1), np.stack([corner, across, below], axis=-1))
    return np.concatenate([half.reshape(-1, 3) for half in halves])
