"""One frame's way through the stages: find, align, cut out, learn or explain, measure.

Owned by one thread. It keeps what must be remembered between frames (where the markers were, the last coefficients) so
that the stages need not; the model and the zero are :class:`engine.learner.Learner`'s.
"""

from dataclasses import dataclass, field

import numpy as np

from engine.active_model import ActiveModel, prepare_model
from engine.calibration import Calibration
from engine.clock import Clock
from engine.frames import (
    FloatArray,
    Lost,
    LostReason,
    Markers,
    Measurement,
    MeasurementState,
    Motion,
    Projection,
    RgbdFrame,
    RoiDepth,
    frozen,
)
from engine.learner import Learner
from engine.model import MotionModel
from engine.polygons import NamedRegion
from engine.split_finder import SplitFinder
from engine.stages import markers as marker_stage
from engine.stages.markers import MarkerSearch
from engine.stages.phase_lag import follow_lags, start_lags
from engine.stages.projection import project
from engine.stages.regions import WIDE, RegionLayout, horizontal_split
from engine.stages.registration import align, look_up_rays, undistorted_rays
from engine.stages.roi import NODE_COLUMNS, NODE_ROWS, NODE_STEP, at_nodes, cut_out, roi_nodes
from engine.stages.surface import end_at_markers, vertices_mm
from engine.threads import keep_calls_in_their_thread
from engine.training import BackgroundTrainer, Trainer, TrainingSettings

RAY_STEP_PX = 8
US_PER_S = 1e6
MARKERS_BETWEEN_NODES = 1.0 - 1.0 / NODE_STEP  # the last nodes lie a pixel of the grid beyond the markers


@dataclass(frozen=True, slots=True, kw_only=True)
class PipelineSettings:
    """How to measure, and from where on a measurement is none.

    Attributes
    ----------
    cell_px
        Side of a region's cell on the grid [px].
    thorax_rows
        Rows of the grid above this are thorax, the others abdomen.
    split
        The line between thorax and abdomen where it is not along a row: the rows where it crosses column 0 and 199.
    extra_markers
        Whether two more stickers at the costal margin mark that line; it is then fixed with the first model.
    points
        Grid points (row, column) to report singly.
    named
        Polygons on the grid to report, each under its name.
    superior_px
        Where the patient's head is in the picture; see :class:`engine.stages.markers.MarkerSearch`.
    max_pair_gap_ms
        How far apart in time depth and colour may be: markers of an older picture say nothing of where the patient is.
    max_layout_change
        Relative change of a distance between two markers at which they are no longer the same layout.
    """

    cell_px: int = 25
    thorax_rows: int = 175
    split: tuple[float, float] | None = None
    extra_markers: bool = False
    points: tuple[tuple[int, int], ...] = ()
    named: tuple[NamedRegion, ...] = ()
    marker_diameter_mm: float = 20.0
    superior_px: tuple[float, float] | None = None
    max_layout_change: float = 0.08
    max_pair_gap_ms: float = 100.0
    min_valid_share: float = 0.5
    min_inlier_share: float = 0.6
    max_residual_mm: float = 8.0
    training: TrainingSettings = field(default_factory=TrainingSettings)

    def __post_init__(self) -> None:
        """Check the grid settings."""
        self.layout()

    def layout(self, marked_split: tuple[float, float] | None = None) -> RegionLayout:
        """Return what motion is averaged over; a line that stickers mark goes before one that was given."""
        split = marked_split or self.split or horizontal_split(self.thorax_rows)
        return RegionLayout(cell_px=self.cell_px, split=split, points=self.points, named=self.named)

    def lag_pairs(self) -> tuple[tuple[str, int, str, int], ...]:
        """Return whose phase lags are told: names, and positions among whole, thorax, abdomen, points and named."""
        named_from = len(WIDE) + len(self.points)
        named = ((region.name, position, WIDE[0], 0) for position, region in enumerate(self.named, start=named_from))
        return ((WIDE[1], 1, WIDE[2], 2), *named)


class Pipeline:
    """Measures frames; see the module."""

    def __init__(
        self,
        calibration: Calibration,
        settings: PipelineSettings,
        clock: Clock,
        trainer: Trainer[ActiveModel] | None = None,
    ) -> None:
        keep_calls_in_their_thread()
        self._calibration = calibration
        self._settings = settings
        self._clock = clock
        self._learner = Learner(
            calibration_sha256=calibration.sha256,
            settings=settings.training,
            prepare=self._prepared,
            trainer=BackgroundTrainer() if trainer is None else trainer,
        )
        self._color_rays = undistorted_rays(calibration.color, RAY_STEP_PX)
        self._depth_rays = undistorted_rays(calibration.depth, RAY_STEP_PX)
        self._markers: Markers | None = None
        self._layout_px: FloatArray | None = None
        self._node_depth_mm: FloatArray | None = None
        self._coefficients: FloatArray | None = None
        self._explained_by: ActiveModel | None = None
        self._split_finder = SplitFinder() if settings.extra_markers else None
        pairs = settings.lag_pairs()
        self._lags = start_lags(pairs, len(WIDE) + len(settings.points) + len(settings.named))

    @property
    def model(self) -> MotionModel | None:
        """The model frames are measured with now."""
        active = self._learner.active
        return None if active is None else active.model

    @property
    def model_shortcoming(self) -> str | None:
        """Why nobody may arm with the present model; None when it will do, or when there is none."""
        return self._learner.shortcoming

    @property
    def has_reference(self) -> bool:
        """Whether there is a zero to measure from."""
        return self._learner.has_reference

    @property
    def model_generation(self) -> int:
        """Changes whenever the model or the reference did: what was armed before is armed no more."""
        return self._learner.generation

    def set_reference(self) -> None:
        """Take the next measured frame as the zero of motion."""
        self._learner.set_reference()

    def retrain(self) -> None:
        """Gather frames for a new model; the present one measures on until the new one is ready."""
        self._learner.retrain()

    def activate(self, model: MotionModel) -> None:
        """Measure with this model as soon as it is prepared; the reference is carried over."""
        self._learner.activate(model)

    def measure(self, frame: RgbdFrame) -> Measurement:
        """Measure one frame.

        Raises
        ------
        CalibrationError
            The camera's pictures are not of the size the calibration is for. Nothing else a frame may hold raises.
        """
        self._calibration.check_sizes(depth=frame.depth_mm.shape, color=frame.color.shape)
        self._learner.collect()
        found = self._find_markers(frame)
        if isinstance(found, Lost):
            self._markers, self._coefficients = None, None
            return self._measurement(frame, MeasurementState.LOST, lost=found)
        nodes_px, roi = self._region(frame, found)
        self._watch_split(frame, found)
        self._learn(roi, frame.timestamp_us, found)
        active = self._learner.active
        if active is None:
            return self._unlearned(frame, roi, found)
        outcome = self._explain(active, roi)
        if isinstance(outcome, Lost):
            self._coefficients = None
            return self._measurement(frame, MeasurementState.LOST, lost=outcome, markers=found)
        self._coefficients, self._explained_by = outcome.coefficients, active
        self._node_depth_mm = active.node_depth_mm(outcome.coefficients)
        motion = self._motion(active, outcome, nodes_px, frame.timestamp_us)
        return self._measurement(frame, MeasurementState.MEASURING, motion=motion, markers=found)

    def _measurement(
        self,
        frame: RgbdFrame,
        state: MeasurementState,
        *,
        motion: Motion | None = None,
        lost: Lost | None = None,
        markers: Markers | None = None,
    ) -> Measurement:
        return Measurement(
            frame_index=frame.index,
            timestamp_us=frame.timestamp_us,
            received_ns=frame.received_ns,
            measured_ns=self._clock.now_ns(),
            missed_frames=frame.missed_frames,
            state=state,
            motion=motion,
            lost=lost,
            markers=markers,
            training=self._learner.progress,
        )

    def _unlearned(self, frame: RgbdFrame, roi: RoiDepth, found: Markers) -> Measurement:
        """Answer for a frame that no model can explain yet."""
        if roi.valid.mean() < self._settings.min_valid_share:
            lost = self._coverage_lost(float(roi.valid.mean()))
            return self._measurement(frame, MeasurementState.LOST, lost=lost, markers=found)
        return self._measurement(frame, MeasurementState.TRAINING, markers=found)

    # -- markers ------------------------------------------------------------------------------------------------

    def _find_markers(self, frame: RgbdFrame) -> Markers | Lost:
        gap_ms = frame.pair_gap_us / 1000.0
        if gap_ms > self._settings.max_pair_gap_ms:
            return Lost(
                reason=LostReason.MARKER_LOST, detail=f"the colour picture is {gap_ms:.0f} ms off the depth frame"
            )
        search = self._marker_search(frame)
        if search is None:
            return self._coverage_lost(0.0)
        found: Markers | Lost | None = None
        if self._markers is not None:
            found = marker_stage.track_markers(frame.color, self._markers.centers_px, search)
        if not isinstance(found, Markers):
            found = marker_stage.find_markers(frame.color, search)
        if isinstance(found, Lost):
            return found
        if self._layout_px is not None:
            change = marker_stage.layout_change(found.centers_px, self._layout_px)
            if change > self._settings.max_layout_change:
                return Lost(
                    reason=LostReason.LAYOUT_CHANGED, detail=f"a distance between markers changed by {change:.0%}"
                )
        self._markers = found
        return found

    def _marker_search(self, frame: RgbdFrame) -> MarkerSearch | None:
        distance_mm = self._distance_mm(frame)
        if distance_mm is None:
            return None
        return MarkerSearch(
            diameter_px=self._settings.marker_diameter_mm * self._calibration.color.fx / distance_mm,
            superior_px=self._settings.superior_px,
        )

    def _distance_mm(self, frame: RgbdFrame) -> float | None:
        """Distance of the chest: as measured last, or the middle of the picture's."""
        if self._node_depth_mm is not None:
            return float(self._node_depth_mm.mean())
        height, width = frame.depth_mm.shape
        middle = frame.depth_mm[height // 3 : -height // 3 : 4, width // 3 : -width // 3 : 4]
        readings = middle[middle > 0]
        return float(np.median(readings)) if readings.size >= 0.1 * middle.size else None

    # -- region -------------------------------------------------------------------------------------------------

    def _region(self, frame: RgbdFrame, found: Markers) -> tuple[FloatArray, RoiDepth]:
        """Cut the region out at the depth expected from the frame before; the first frame has to settle first."""
        color_nodes = roi_nodes(found.centers_px)
        rays = look_up_rays(self._color_rays, RAY_STEP_PX, color_nodes)
        rounds = 1
        if self._node_depth_mm is None:
            self._node_depth_mm = np.full(NODE_ROWS * NODE_COLUMNS, self._distance_mm(frame) or 1.0)
            rounds = 3
        for _ in range(rounds):
            nodes_px = align(rays, self._node_depth_mm, self._calibration)
            roi = self._corrected(cut_out(frame.depth_mm, nodes_px))
            if self._learner.active is None:
                self._node_depth_mm = _blended(self._node_depth_mm, roi, 1.0 if rounds > 1 else 0.3)
        return nodes_px, roi

    def _corrected(self, roi: RoiDepth) -> RoiDepth:
        correction = self._calibration.depth_correction
        if correction is None:
            return roi
        depth = roi.depth_mm * np.float32(correction.scale) + np.float32(correction.offset_mm)
        return RoiDepth(depth_mm=depth, valid=roi.valid)

    # -- learning -----------------------------------------------------------------------------------------------

    def _learn(self, roi: RoiDepth, timestamp_us: int, found: Markers) -> None:
        if not self._learner.is_gathering or roi.valid.mean() < self._settings.min_valid_share:
            return
        if self._layout_px is None:
            self._layout_px = found.centers_px
        self._learner.learn(roi, timestamp_us)

    def _prepared(self, model: MotionModel) -> ActiveModel:
        """Work everything out that frames will need; called wherever the trainer runs."""
        return prepare_model(model, self._settings.layout(self.marked_split))

    @property
    def marked_split(self) -> tuple[float, float] | None:
        """Where the patient's own stickers part thorax from abdomen, as far as that was looked for and seen."""
        return None if self._split_finder is None else self._split_finder.split

    def _watch_split(self, frame: RgbdFrame, found: Markers) -> None:
        search = self._marker_search(frame) if self._split_finder is not None and self._learner.active is None else None
        if self._split_finder is not None and search is not None:
            self._split_finder.look(frame.color, search, found.centers_px)

    # -- measuring ----------------------------------------------------------------------------------------------

    def _explain(self, active: ActiveModel, roi: RoiDepth) -> Projection | Lost:
        wanted = self._settings
        before = self._coefficients if self._explained_by is active else None
        best = project(active.basis, roi, before)
        if best is None or best.valid_share < wanted.min_valid_share:
            return self._coverage_lost(0.0 if best is None else best.valid_share)
        if best.inlier_share < wanted.min_inlier_share or not best.residual_mm <= wanted.max_residual_mm:
            return Lost(
                reason=LostReason.RESIDUAL_HIGH,
                detail=f"a region misses the model by {best.residual_mm:.1f} mm, {best.inlier_share:.0%} of it fits",
            )
        return best

    def _motion(self, active: ActiveModel, outcome: Projection, nodes_px: FloatArray, timestamp_us: int) -> Motion:
        depth_mm = active.regions.depth_mm(outcome.coefficients)
        node_depth_mm = active.node_depth_mm(outcome.coefficients)
        ends_px = end_at_markers(nodes_px, NODE_ROWS, NODE_COLUMNS, MARKERS_BETWEEN_NODES)
        rays = look_up_rays(self._depth_rays, RAY_STEP_PX, ends_px)
        surface = vertices_mm(rays, node_depth_mm)
        reference = self._learner.reference(active, outcome.coefficients, surface)
        motion_mm = reference.regions_mm - depth_mm
        regions = active.regions
        cells, shape = regions.cells, (regions.rows, regions.columns)
        self._lags = follow_lags(self._lags, timestamp_us / US_PER_S, -depth_mm[cells:])
        whole, thorax, abdomen = motion_mm[cells : regions.points_from].tolist()
        return Motion(
            whole_mm=whole,
            thorax_mm=thorax,
            abdomen_mm=abdomen,
            volume_l=reference.volume_above_l(surface),
            regions_mm=motion_mm[:cells].reshape(shape),
            regions_depth_mm=depth_mm[:cells].reshape(shape),
            points_mm=motion_mm[regions.points_from : regions.named_from],
            named_mm=motion_mm[regions.named_from :],
            projection=outcome,
            lags=self._lags.lags,
            surface_mm=frozen(surface),
            split_rows=regions.layout.split,
        )

    def _coverage_lost(self, share: float) -> Lost:
        return Lost(reason=LostReason.COVERAGE_LOW, detail=f"the camera sees {share:.0%} of the region")


def _blended(before_mm: FloatArray, roi: RoiDepth, share: float) -> FloatArray:
    """Follow the surface at the nodes before there is a model: a little of each frame, nothing from holes."""
    valid = at_nodes(roi.valid.astype(np.float32))
    return np.where(valid > 0.0, (1.0 - share) * before_mm + share * at_nodes(roi.depth_mm), before_mm)
