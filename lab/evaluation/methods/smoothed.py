"""A simple method beside ours: PCA of a whole recording with smoothed components; ours must never lose to it.

The region is sampled as ours is: markers, registration, steps of the sensor undone. Then the mean of every point fills
its gaps, and four principal components of all frames are smoothed by a Gaussian of 12 px. No robust weights, no prior,
no cosines, no reference but a frame, and nothing is refused.
"""

import cv2
import numpy as np

from engine.calibration.camera_calibration import Calibration
from engine.core.frames import ROI_COLUMNS, ROI_ROWS, BoolArray, FloatArray, Markers, RgbdFrame
from engine.motion.settings import PipelineSettings
from engine.motion.tracking.region_tracker import RegionTracker
from lab.evaluation.methods.outcome import HALF_ROWS, Track, cell_means
from lab.phantom.truth import POINTS_RC

COMPONENTS = 4
SMOOTHING_PX = 12.0
STRIDE_PX = 2


class SmoothedPca:
    """Collects the frames of a recording, and measures all of them in the end."""

    def __init__(self, calibration: Calibration, settings: PipelineSettings, frames: int) -> None:
        self._tracker = RegionTracker(
            calibration,
            marker_diameter_mm=settings.marker_diameter_mm,
            superior_px=settings.superior_px,
            max_pair_gap_ms=settings.max_pair_gap_ms,
            max_layout_change=settings.max_layout_change,
        )
        shape = (frames, -(-ROI_ROWS // STRIDE_PX), -(-ROI_COLUMNS // STRIDE_PX))
        self._depth_mm = np.full(shape, np.nan, dtype=np.float32)

    def add_frame(self, frame: RgbdFrame) -> None:
        """Sample a frame's region; left out are frames without markers, and the first, before the steps are known."""
        found = self._tracker.find(frame)
        if isinstance(found, Markers) and self._tracker.table.is_settled:
            _, roi = self._tracker.region(frame, found, STRIDE_PX, has_model=False)
            self._depth_mm[frame.index] = np.where(roi.valid, roi.depth_mm, np.float32(np.nan))

    def track(self) -> Track:
        """Learn from all frames, and return the depth that the model gives in each."""
        track = Track.empty(len(self._depth_mm))
        seen = np.flatnonzero(np.isfinite(self._depth_mm).any(axis=(1, 2)))
        if len(seen) <= COMPONENTS:
            return track
        depth_mm = self._depth_mm[seen]
        known = np.asarray(np.isfinite(depth_mm).any(axis=0))
        mean_mm = np.zeros(known.shape, dtype=np.float32)
        mean_mm[known] = np.nanmean(depth_mm[:, known], axis=0)
        centred = np.nan_to_num(depth_mm - mean_mm).reshape(len(seen), -1)
        scores = np.linalg.eigh(centred @ centred.T)[1][:, ::-1][:, :COMPONENTS]
        shapes = [_smoothed((score @ centred).reshape(known.shape), known) for score in scores.T]
        surfaces = np.stack([_on_grid(shape) for shape in (_smoothed(mean_mm, known), *shapes)])
        weights = np.column_stack([np.ones(len(seen)), scores])
        track.cells_mm[seen] = np.tensordot(weights, cell_means(surfaces), axes=1)
        halves = np.stack(
            [surfaces[:, :HALF_ROWS].mean(axis=(1, 2)), surfaces[:, HALF_ROWS:].mean(axis=(1, 2))], axis=1
        )
        track.wide_mm[seen, 1:] = weights @ halves
        track.wide_mm[seen, 0] = track.wide_mm[seen, 1:].mean(axis=1)
        track.points_mm[seen] = weights @ surfaces[:, POINTS_RC[:, 0], POINTS_RC[:, 1]]
        track.beta[seen] = scores[:, : track.beta.shape[1]]
        return track


def _smoothed(surface: FloatArray, known: BoolArray) -> FloatArray:
    """Smooth what is known; slopes are continued at the edge."""
    sigma = SMOOTHING_PX / STRIDE_PX
    margin = int(3.0 * sigma) + 1

    def blurred(values: FloatArray) -> FloatArray:
        padded = np.pad(values, margin, mode="reflect", reflect_type="odd")
        return np.asarray(cv2.GaussianBlur(padded, (0, 0), sigma)[margin:-margin, margin:-margin])

    weight = blurred(known.astype(np.float32))
    return np.asarray(blurred(np.where(known, surface, np.float32(0.0)).astype(np.float32)) / np.maximum(weight, 0.05))


def _on_grid(surface: FloatArray) -> FloatArray:
    """Interpolate a thinned surface to the full grid, shape (350, 200)."""
    rows, columns = np.arange(ROI_ROWS) / STRIDE_PX, np.arange(ROI_COLUMNS) / STRIDE_PX
    map_x, map_y = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    return np.asarray(
        cv2.remap(surface.astype(np.float32), map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    )
