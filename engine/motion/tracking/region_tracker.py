"""Tracks the markers and samples the region in each frame; independent of the motion model.

Owned by the pipeline's thread. It keeps the last marker positions, their layout at the first training, and the last
depth of the skin.

Converts a camera's readings to depth [mm]: quantisation steps from the first frames, scale from the calibration.

The table is fixed after the first frames: a model learned with one table is not used with another.
"""

from dataclasses import replace

import numpy as np

from engine.calibration.camera_calibration import Calibration, DepthCorrection
from engine.calibration.quantisation import DEPTH_VALUES, DepthSteps, count_readings, depth_table_mm, find_steps
from engine.core.frames import (
    NODE_COLUMNS,
    NODE_ROWS,
    DepthImage,
    FloatArray,
    Lost,
    LostReason,
    Markers,
    RgbdFrame,
    RoiDepth,
    frozen,
)
from engine.core.sentences import listed, say
from engine.motion.stages import markers as marker_stage
from engine.motion.stages.markers import MarkerSearch
from engine.motion.stages.roi import Aligned, align, at_nodes, cut_out, roi_nodes

# This many pictures contain the depth levels of the region.
COUNTED_FRAMES = 12
ROUNDS_AT_FIRST = 3
FOLLOWED_SHARE = 0.3


class DepthTable:
    """Estimates the depth of each reading from the first frames.

    ``is_settled`` is whether enough frames were counted, so that the table is final; ``steps`` are those of the
    sensor's readings, None before that, and for a sensor without steps.
    """

    def __init__(self, correction: DepthCorrection | None) -> None:
        self._correction = correction
        self._frames, self.is_settled = 0, False
        self._counts = np.zeros(DEPTH_VALUES, dtype=np.int64)
        self.steps: DepthSteps | None = None
        self.table_mm = self._corrected(depth_table_mm(None))

    def count(self, depth_mm: DepthImage) -> None:
        """Count one picture's readings; the last one completes the table."""
        self._counts += count_readings(depth_mm)
        self._frames += 1
        self.is_settled = self._frames >= COUNTED_FRAMES
        if self.is_settled:
            self.steps = find_steps(self._counts)
            self.table_mm = self._corrected(depth_table_mm(self.steps))

    def _corrected(self, table_mm: FloatArray) -> FloatArray:
        correction = self._correction
        if correction is None:
            return table_mm
        return frozen((table_mm * correction.scale + correction.offset_mm).astype(np.float32))


class RegionTracker:
    """Markers and region of the current frame; the keyword arguments are fields of `PipelineSettings`.

    Attributes
    ----------
    table
        The depth of each reading.
    """

    def __init__(
        self,
        calibration: Calibration,
        *,
        marker_diameter_mm: float,
        superior_px: tuple[float, float] | None,
        max_pair_gap_ms: float,
        max_layout_change: float,
    ) -> None:
        self._calibration = calibration
        self._depth_from_color = calibration.color_from_depth.inverse
        self._marker_diameter_mm, self._superior_px = marker_diameter_mm, superior_px
        self._max_pair_gap_ms, self._max_layout_change = max_pair_gap_ms, max_layout_change
        self.table = DepthTable(calibration.depth_correction)
        self._markers: Markers | None = None
        self._last_px: FloatArray | None = None
        self._layout_px: FloatArray | None = None
        self._node_depth_mm: FloatArray | None = None
        self._is_depth_modelled = False

    @property
    def has_layout(self) -> bool:
        """Whether the markers' layout is fixed."""
        return self._layout_px is not None

    def reset(self) -> None:
        """Discard the marker positions: the next frame is searched completely."""
        self._markers = None

    def fix_layout(self, found: Markers) -> None:
        """Fix the markers' layout that later frames are compared with."""
        self._layout_px = found.centers_px

    def expect_depth(self, node_depth_mm: FloatArray) -> None:
        """Set the expected depth of the next frame's nodes [mm], shape (nodes,)."""
        self._node_depth_mm, self._is_depth_modelled = node_depth_mm, True

    def find(self, frame: RgbdFrame) -> Markers | Lost:
        """Find the markers, first near their last positions; return the reason if they are lost."""
        if not self.table.is_settled:
            self.table.count(frame.depth_mm)
        gap_ms = frame.pair_gap_us / 1000.0
        if gap_ms > self._max_pair_gap_ms:
            return Lost(
                reason=LostReason.MARKER_LOST,
                detail=say("colour picture and depth frame are {gap_ms:.0f} ms apart", gap_ms=gap_ms),
            )
        search = self.search(frame)
        if search is None:
            return coverage_lost(0.0)
        found = self._seen(frame, search)
        if isinstance(found, Lost):
            return self._explain_loss(frame, search, found)
        changed = self._layout_lost(found)
        if changed is None:
            self._markers, self._last_px = found, found.centers_px
        return changed or found

    def _seen(self, frame: RgbdFrame, search: MarkerSearch) -> Markers | Lost:
        """Search near the last positions, then the whole picture; a loss names the markers that are missing."""
        tracked: Markers | Lost | None = None
        if self._markers is not None:
            tracked = marker_stage.track_markers(frame.color, self._markers.centers_px, search)
            if isinstance(tracked, Markers):
                return tracked
        found = marker_stage.find_markers(frame.color, search)
        if isinstance(found, Markers) or self._last_px is None:
            return found
        missing = tracked or marker_stage.track_markers(frame.color, self._last_px, search)
        return (
            replace(found, detail=listed(": ", (found.detail, missing.detail))) if isinstance(missing, Lost) else found
        )

    def _layout_lost(self, found: Markers) -> Lost | None:
        """Return the reason if the layout differs from the fixed one, otherwise None."""
        if self._layout_px is None:
            return None
        change = marker_stage.layout_change(found.centers_px, self._layout_px)
        if change <= self._max_layout_change:
            return None
        return Lost(
            reason=LostReason.LAYOUT_CHANGED,
            detail=say("a distance between markers changed by {change:.0%}", change=change),
        )

    def search(self, frame: RgbdFrame) -> MarkerSearch | None:
        """Return the search parameters; None if the distance of the chest is unknown."""
        distance_mm = self._distance_mm(frame)
        if not distance_mm:
            return None
        return MarkerSearch(
            diameter_px=self._marker_diameter_mm * self._calibration.color.fx / distance_mm,
            superior_px=self._superior_px,
        )

    def _explain_loss(self, frame: RgbdFrame, search: MarkerSearch, lost: Lost) -> Lost:
        """Discard an implausible distance of the skin; return the reason of the loss, with that distance."""
        if marker_stage.refuse_size(frame.color, search) is not None:
            distance_mm = self._distance_mm(frame) or 0.0
            self._node_depth_mm = None
            return replace(
                lost,
                detail=say(
                    "the object in view is {distance_mm:.0f} mm away: {detail}",
                    distance_mm=distance_mm,
                    detail=lost.detail,
                ),
            )
        if self._node_depth_mm is not None and not self._is_depth_modelled:
            # Before there is a model, a single bad picture may have spoilt the distance.
            seen_mm = _middle_distance_mm(frame)
            ratio = 1.0 if seen_mm is None else seen_mm / float(self._node_depth_mm.mean())
            if not 1.0 / search.diameter_tolerance <= ratio <= search.diameter_tolerance:
                self._node_depth_mm = None
        return lost

    def region(self, frame: RgbdFrame, found: Markers, stride_px: int, *, has_model: bool) -> tuple[Aligned, RoiDepth]:
        """Sample the region at the depth expected from the previous frame; the first frame is iterated.

        Parameters
        ----------
        stride_px
            Sample every ``stride_px``-th row and column of the grid.
        has_model
            Whether the model gives the expected depth; otherwise it follows the sampled surface.

        Returns
        -------
        tuple[Aligned, RoiDepth]
            The nodes in the depth camera, and the region's depth.
        """
        color_rays = self._calibration.color.rays(roi_nodes(found.centers_px))
        rounds = 1
        if self._node_depth_mm is None:
            self._node_depth_mm = np.full(NODE_ROWS * NODE_COLUMNS, self._distance_mm(frame) or 1.0)
            self._is_depth_modelled = False
            rounds = ROUNDS_AT_FIRST
        for _ in range(rounds):
            nodes = align(color_rays, self._node_depth_mm, self._depth_from_color, self._calibration.depth)
            roi = cut_out(frame.depth_mm, nodes.pixels_px, self.table.table_mm, stride_px)
            if not has_model:
                self._node_depth_mm = _low_pass(self._node_depth_mm, roi, 1.0 if rounds > 1 else FOLLOWED_SHARE)
        return nodes, roi

    def _distance_mm(self, frame: RgbdFrame) -> float | None:
        """Distance of the chest: as last measured, otherwise that of the picture's middle [mm]."""
        if self._node_depth_mm is not None:
            return float(np.add.reduce(self._node_depth_mm)) / len(self._node_depth_mm)  # their mean, sooner
        return _middle_distance_mm(frame)


def _middle_distance_mm(frame: RgbdFrame) -> float | None:
    """Median depth in the middle of the picture [mm]; None if under 10 % of it has a reading."""
    height, width = frame.depth_mm.shape
    middle = frame.depth_mm[height // 3 : -height // 3 : 4, width // 3 : -width // 3 : 4]
    readings = middle[middle > 0]
    return float(np.median(readings)) if readings.size >= 0.1 * middle.size else None


def coverage_lost(share: float) -> Lost:
    """Return the loss for too few readings in the region, a share from 0 to 1."""
    return Lost(reason=LostReason.COVERAGE_LOW, detail=say("the camera sees {share:.0%} of the region", share=share))


def _low_pass(before_mm: FloatArray, roi: RoiDepth, share: float) -> FloatArray:
    """Low-pass filter the surface at the nodes before there is a model [mm], shape (nodes,); holes keep their value."""
    valid = at_nodes(roi.valid, roi.stride_px) > 0.0
    return np.where(valid, (1.0 - share) * before_mm + share * at_nodes(roi.depth_mm, roi.stride_px), before_mm)
