"""Finds the markers and cuts the region out, frame after frame: what must be remembered for it, and nothing of a model.

Owned by the pipeline. It remembers where the markers were, how they lay to each other when the first model was learned,
and how far away the skin was.
"""

import numpy as np

from engine.calibration import Calibration
from engine.depth_table import DepthTable
from engine.frames import FloatArray, Lost, LostReason, Markers, RgbdFrame, RoiDepth
from engine.stages import markers as marker_stage
from engine.stages.markers import MarkerSearch
from engine.stages.registration import Aligned, align
from engine.stages.roi import NODE_COLUMNS, NODE_ROWS, at_nodes, cut_out, roi_nodes

ROUNDS_AT_FIRST = 3
FOLLOWED_SHARE = 0.3


class RegionFinder:
    """Where the region is; ``marker_diameter_mm`` and what follows are the pipeline's settings."""

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
        self._table = DepthTable(calibration.depth_correction)
        self._markers: Markers | None = None
        self._layout_px: FloatArray | None = None
        self._node_depth_mm: FloatArray | None = None

    @property
    def is_settled(self) -> bool:
        """Whether it is known what the depth readings mean."""
        return self._table.is_settled

    @property
    def has_layout(self) -> bool:
        """Whether it is known how the markers lie to each other."""
        return self._layout_px is not None

    def forget(self) -> None:
        """Look for the markers anew: the patient was not seen."""
        self._markers = None

    def keep_layout(self, found: Markers) -> None:
        """Hold every later frame against how the markers lie now."""
        self._layout_px = found.centers_px

    def expect(self, node_depth_mm: FloatArray) -> None:
        """Look for the next frame's region at this depth of its nodes [mm]."""
        self._node_depth_mm = node_depth_mm

    def find(self, frame: RgbdFrame) -> Markers | Lost:
        """Find the markers, near where they were if that is known."""
        if not self._table.is_settled:
            self._table.look_at(frame.depth_mm)
        gap_ms = frame.pair_gap_us / 1000.0
        if gap_ms > self._max_pair_gap_ms:
            return Lost(
                reason=LostReason.MARKER_LOST, detail=f"the colour picture is {gap_ms:.0f} ms off the depth frame"
            )
        search = self.search(frame)
        if search is None:
            return coverage_lost(0.0)
        found: Markers | Lost | None = None
        if self._markers is not None:
            found = marker_stage.track_markers(frame.color, self._markers.centers_px, search)
        if not isinstance(found, Markers):
            found = marker_stage.find_markers(frame.color, search)
        if isinstance(found, Lost):
            return found
        changed = self._layout_lost(found)
        if changed is None:
            self._markers = found
        return changed or found

    def _layout_lost(self, found: Markers) -> Lost | None:
        """Return why these cannot be the same four markers; None when they can."""
        if self._layout_px is None:
            return None
        change = marker_stage.layout_change(found.centers_px, self._layout_px)
        if change <= self._max_layout_change:
            return None
        return Lost(reason=LostReason.LAYOUT_CHANGED, detail=f"a distance between markers changed by {change:.0%}")

    def search(self, frame: RgbdFrame) -> MarkerSearch | None:
        """Say what to look for; None where the camera does not see how far away the chest is."""
        distance_mm = self._distance_mm(frame)
        if distance_mm is None:
            return None
        return MarkerSearch(
            diameter_px=self._marker_diameter_mm * self._calibration.color.fx / distance_mm,
            superior_px=self._superior_px,
        )

    def region(self, frame: RgbdFrame, found: Markers, stride_px: int, *, has_model: bool) -> tuple[Aligned, RoiDepth]:
        """Cut the region out at the depth expected from the frame before; the first frame has to settle first."""
        color_rays = self._calibration.color.rays(roi_nodes(found.centers_px))
        rounds = 1
        if self._node_depth_mm is None:
            self._node_depth_mm = np.full(NODE_ROWS * NODE_COLUMNS, self._distance_mm(frame) or 1.0)
            rounds = ROUNDS_AT_FIRST
        for _ in range(rounds):
            nodes = align(color_rays, self._node_depth_mm, self._depth_from_color, self._calibration.depth)
            roi = cut_out(frame.depth_mm, nodes.pixels_px, self._table.table_mm, stride_px)
            if not has_model:
                self._node_depth_mm = _blended(self._node_depth_mm, roi, 1.0 if rounds > 1 else FOLLOWED_SHARE)
        return nodes, roi

    def _distance_mm(self, frame: RgbdFrame) -> float | None:
        """Distance of the chest: as measured last, or the middle of the picture's."""
        if self._node_depth_mm is not None:
            return float(self._node_depth_mm.mean())
        height, width = frame.depth_mm.shape
        middle = frame.depth_mm[height // 3 : -height // 3 : 4, width // 3 : -width // 3 : 4]
        readings = middle[middle > 0]
        return float(np.median(readings)) if readings.size >= 0.1 * middle.size else None


def coverage_lost(share: float) -> Lost:
    """Say that the camera sees too little of the region, a share from 0 to 1."""
    return Lost(reason=LostReason.COVERAGE_LOW, detail=f"the camera sees {share:.0%} of the region")


def _blended(before_mm: FloatArray, roi: RoiDepth, share: float) -> FloatArray:
    """Follow the surface at the nodes before there is a model: a little of each frame, nothing from holes."""
    valid = at_nodes(roi.valid, roi.stride_px) > 0.0
    return np.where(valid, (1.0 - share) * before_mm + share * at_nodes(roi.depth_mm, roi.stride_px), before_mm)
