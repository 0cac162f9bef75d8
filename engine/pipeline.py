"""One frame's way through the stages: find, align, cut out, learn or explain, measure.

Owned by one thread. It keeps what must be remembered between frames (where the markers were, the last coefficients) so
that the stages need not; the model and the zero are :class:`engine.learner.Learner`'s.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

from engine.active_model import ActiveModel, Reference, prepare_model
from engine.breath import WHOLE, Breath, SignalChoice
from engine.breath_watch import BreathWatch, check_signals
from engine.calibration import Calibration
from engine.clock import Clock
from engine.continuity import Continuity, Seen
from engine.errands import LearningStages, Outcome
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
from engine.gathering import GatheredFrame
from engine.learner import Learner
from engine.likeness import Likeness, LikenessLimits
from engine.memory import keep_freed_memory
from engine.model import MotionModel
from engine.notices import LearningNotice
from engine.polygons import NamedRegion
from engine.quiet import RecentFrames
from engine.region_finder import RegionFinder, coverage_lost
from engine.split_finder import SplitFinder
from engine.stages.phase_lag import follow_lags, start_lags
from engine.stages.projection import STRIDE_PX, project
from engine.stages.regions import WIDE, RegionLayout, horizontal_split
from engine.stages.roi import NODE_COLUMNS, NODE_ROWS, NODE_STEP
from engine.stages.surface import end_at_markers, vertices_mm
from engine.threads import keep_calls_in_their_thread
from engine.training import BackgroundTrainer, Trainer, TrainingSettings
from engine.windows import Ranges

US_PER_S = 1e6
MARKERS_BETWEEN_NODES = 1.0 - 1.0 / NODE_STEP
# What is learned must serve finer than what is measured: its shapes are drawn on the full grid.
LEARNING_STRIDE_PX = 2


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
    breath_signals
        Whose breath is followed, at most four.
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
    breath_signals: tuple[SignalChoice, ...] = (WHOLE,)
    marker_diameter_mm: float = 20.0
    superior_px: tuple[float, float] | None = None
    max_layout_change: float = 0.08
    max_pair_gap_ms: float = 100.0
    min_valid_share: float = 0.5
    min_inlier_share: float = 0.6
    max_residual_mm: float = 4.0
    training: TrainingSettings = field(default_factory=TrainingSettings)
    likeness: LikenessLimits = field(default_factory=LikenessLimits)

    def __post_init__(self) -> None:
        """Check the grid settings and the signals."""
        self.layout()
        check_signals(self.breath_signals)

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
        trainer: Trainer[Outcome] | None = None,
    ) -> None:
        keep_calls_in_their_thread()
        keep_freed_memory()
        self._calibration = calibration
        self._settings = settings
        self._clock = clock
        self._learner = Learner(
            calibration_sha256=calibration.sha256,
            settings=settings.training,
            likeness=settings.likeness,
            stages=LearningStages(prepare=self._prepared, explain=self._explained, vertices=self._vertices),
            trainer=BackgroundTrainer() if trainer is None else trainer,
        )
        self._finder = RegionFinder(
            calibration,
            marker_diameter_mm=settings.marker_diameter_mm,
            superior_px=settings.superior_px,
            max_pair_gap_ms=settings.max_pair_gap_ms,
            max_layout_change=settings.max_layout_change,
        )
        self._recent = RecentFrames()
        self._continuity = Continuity()
        self._coefficients: FloatArray | None = None
        self._explained_by: ActiveModel | None = None
        self._split_finder = SplitFinder() if settings.extra_markers else None
        self._begin_to_follow()

    def _begin_to_follow(self) -> None:
        """Know of no breath yet, and of no zero."""
        settings = self._settings
        self._breaths = BreathWatch(settings.breath_signals)
        self._zero: Reference | None = None
        self._lags = start_lags(settings.lag_pairs(), len(WIDE) + len(settings.points) + len(settings.named))

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

    @property
    def is_model_waiting(self) -> bool:
        """Whether a model is ready and waits for the gate to be disarmed."""
        return self._learner.is_model_waiting

    @property
    def likeness(self) -> Likeness | None:
        """How far today's patient is from the stored model that was begun with."""
        return self._learner.likeness

    @property
    def zero_number(self) -> int:
        """Counts the zeros that were set; one that is carried over to another model is the same."""
        return self._learner.zero_number

    def learned_ranges(self, choices: Iterable[SignalChoice]) -> Ranges:
        """Return the range each signal had while the model was learned, against the present zero."""
        return self._learner.learned_ranges(choices)

    def take_notices(self) -> list[LearningNotice]:
        """Return what the learning has to tell since the last call."""
        return self._learner.take_notices()

    def keep_model(self, *, is_kept: bool) -> None:
        """Say whether the present model must stay: a gate that is armed decides by it."""
        self._learner.keep_model(is_kept=is_kept)

    def set_reference(self) -> None:
        """Take the next measured frame as the zero of motion."""
        self._learner.set_reference()

    def retrain(self, *, keeps_zero: bool = True) -> None:
        """Gather frames for a new model; the present one measures on until the new one is ready."""
        self._learner.retrain(keeps_zero=keeps_zero)

    def activate(self, model: MotionModel) -> None:
        """Measure with a known model of this patient once the zero is carried over to it."""
        self._learner.activate(model)

    def apply_model(self) -> None:
        """Swap to the model that waits; the caller has disarmed."""
        self._learner.apply_model()

    def correct_baseline(self, choice: SignalChoice, by: float) -> None:
        """Tell that signal's drift against so much more than was learned [mm or l]: a person has confirmed it."""
        self._breaths.correct(choice, by)

    def resume(self, model: MotionModel) -> None:
        """Begin with a model of an earlier fraction, which is compared with the patient; before the first frame."""
        self._learner.resume(model)

    def camera_returned(self) -> None:
        """Hear that the camera was away, and may hang elsewhere: nothing of before is compared with what comes now."""
        self._forget()
        self._begin_to_follow()
        self._learner.doubt()

    def measure(self, frame: RgbdFrame) -> Measurement:
        """Measure one frame.

        Raises
        ------
        CalibrationError
            The camera's pictures are not of the size the calibration is for. Nothing else a frame may hold raises.
        """
        self._calibration.check_sizes(depth=frame.depth_mm.shape, color=frame.color.shape)
        self._learner.collect(frame.timestamp_us)
        found = self._finder.find(frame)
        if isinstance(found, Lost):
            self._forget()
            return self._measurement(frame, MeasurementState.LOST, lost=found)
        is_learning = self._learner.active is None or self._learner.is_gathering
        stride_px = LEARNING_STRIDE_PX if is_learning else STRIDE_PX
        nodes, roi = self._finder.region(frame, found, stride_px, has_model=self._learner.active is not None)
        if not self._finder.is_settled:
            return self._unlearned(frame, roi, found)
        self._watch_split(frame, found)
        takes_lost_frames = self._learner.takes_lost_frames
        if takes_lost_frames:
            self._learn(roi, frame.timestamp_us, found, nodes.pixels_px)
        self._recent.add(roi, frame.timestamp_us)
        active = self._learner.active
        if active is None:
            return self._unlearned(frame, roi, found)
        outcome = self._believed(active, roi, found, frame.timestamp_us)
        if isinstance(outcome, Lost):
            return self._lost(frame, outcome, found)
        self._coefficients, self._explained_by = outcome.coefficients, active
        self._finder.expect(active.node_depth_mm(outcome.coefficients))
        motion = self._motion(active, outcome, nodes.rays, frame.timestamp_us)
        if not takes_lost_frames:
            self._learn(roi, frame.timestamp_us, found, nodes.pixels_px)
        breaths = self._breaths.follow(motion, frame.timestamp_us)
        return self._measurement(frame, MeasurementState.MEASURING, motion=motion, markers=found, breaths=breaths)

    def _measurement(
        self,
        frame: RgbdFrame,
        state: MeasurementState,
        *,
        motion: Motion | None = None,
        lost: Lost | None = None,
        markers: Markers | None = None,
        breaths: tuple[Breath, ...] = (),
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
            breaths=breaths,
        )

    def _lost(self, frame: RgbdFrame, lost: Lost, found: Markers) -> Measurement:
        """Answer for a frame that the model does not explain."""
        self._coefficients = None
        self._recent.forget()
        if lost.reason is LostReason.RESIDUAL_HIGH:
            self._continuity.interrupt()
        return self._measurement(frame, MeasurementState.LOST, lost=lost, markers=found)

    def _forget(self) -> None:
        """Begin anew with the next frame: the patient was not seen."""
        self._finder.forget()
        self._coefficients = None
        self._recent.forget()

    def _unlearned(self, frame: RgbdFrame, roi: RoiDepth, found: Markers) -> Measurement:
        """Answer for a frame that no model can explain yet."""
        if roi.valid.mean() < self._settings.min_valid_share:
            lost = coverage_lost(float(roi.valid.mean()))
            return self._measurement(frame, MeasurementState.LOST, lost=lost, markers=found)
        return self._measurement(frame, MeasurementState.TRAINING, markers=found)

    # -- learning -----------------------------------------------------------------------------------------------

    def _learn(self, roi: RoiDepth, timestamp_us: int, found: Markers, nodes_px: FloatArray) -> None:
        if self._finder.has_layout and not self._learner.is_gathering:
            return
        if roi.valid.mean() < self._settings.min_valid_share:
            return
        if not self._finder.has_layout:
            self._finder.keep_layout(found)
        if self._learner.is_gathering:
            self._learner.learn(GatheredFrame(roi=roi, timestamp_us=timestamp_us, nodes_px=nodes_px))

    def _prepared(self, model: MotionModel) -> ActiveModel:
        """Work everything out that frames will need; called wherever the trainer runs."""
        return prepare_model(model, self._settings.layout(self.marked_split))

    @property
    def marked_split(self) -> tuple[float, float] | None:
        """Where the patient's own stickers part thorax from abdomen, as far as that was looked for and seen."""
        return None if self._split_finder is None else self._split_finder.split

    def _watch_split(self, frame: RgbdFrame, found: Markers) -> None:
        # Not while a model is fitted: which pictures it then knew of would hang on how long its thread takes.
        is_wanted = self._learner.active is None and self._learner.is_gathering
        search = self._finder.search(frame) if self._split_finder is not None and is_wanted else None
        if self._split_finder is not None and search is not None:
            self._split_finder.look(frame.color, search, found.centers_px)

    def _explained(self, active: ActiveModel, roi: RoiDepth, start: FloatArray | None) -> Projection | None:
        """Explain a region as a frame's would be; called wherever the trainer runs."""
        best = project(active.basis, roi, start)
        return best if best is not None and self._refusal(best) is None else None

    def _vertices(self, nodes_px: FloatArray, depth_mm: FloatArray) -> FloatArray:
        """Find the points of the surface at the nodes; called wherever the trainer runs."""
        return _surface(self._calibration.depth.rays(nodes_px)[:, :2], depth_mm)

    # -- measuring ----------------------------------------------------------------------------------------------

    def _explain(self, active: ActiveModel, roi: RoiDepth) -> Projection | Lost:
        before = self._coefficients if self._explained_by is active else None
        best = project(active.basis, roi, before)
        return coverage_lost(0.0) if best is None else self._refusal(best) or best

    def _believed(self, active: ActiveModel, roi: RoiDepth, found: Markers, timestamp_us: int) -> Projection | Lost:
        """Explain a frame, if it may be the surface of the frame before."""
        outcome = self._explain(active, roi)
        return outcome if isinstance(outcome, Lost) else self._doubt(active, outcome, found, timestamp_us) or outcome

    def _doubt(self, active: ActiveModel, outcome: Projection, found: Markers, timestamp_us: int) -> Lost | None:
        """Return why this cannot be the surface of the frame before; None when it can."""
        self._continuity.begin_anew(self._learner.generation)
        depth_mm = active.node_depth_mm(outcome.coefficients)
        seen = Seen(depth_mm=depth_mm, markers_px=found.centers_px, timestamp_us=timestamp_us)
        detail = self._continuity.doubt(seen, active.node_modes[: active.basis.components], active.model.noise_mm)
        return Lost(reason=LostReason.RESIDUAL_HIGH, detail=detail) if detail else None

    def _refusal(self, best: Projection) -> Lost | None:
        """Why a frame that was explained so is not measured; None when it is."""
        wanted = self._settings
        if best.valid_share < wanted.min_valid_share:
            return coverage_lost(best.valid_share)
        if best.inlier_share < wanted.min_inlier_share or not best.residual_mm <= wanted.max_residual_mm:
            return Lost(
                reason=LostReason.RESIDUAL_HIGH,
                detail=f"a region misses the model by {best.residual_mm:.1f} mm, {best.inlier_share:.0%} of it fits",
            )
        return None

    def _motion(self, active: ActiveModel, outcome: Projection, rays: FloatArray, timestamp_us: int) -> Motion:
        depth_mm = active.regions.depth_mm(outcome.coefficients)
        node_depth_mm = active.node_depth_mm(outcome.coefficients)
        surface = _surface(rays, node_depth_mm)
        self._lags = follow_lags(self._lags, timestamp_us / US_PER_S, -depth_mm[active.regions.cells :])
        is_zero_new = self._learner.is_zero_due
        zero, reference = self._zero, self._reference(active, outcome, surface, rays)
        motion = self._against(reference, active, outcome, depth_mm, surface)
        if self._breaths.is_zero_moved(active, is_zero_new=is_zero_new) and zero is not None:
            self._breaths.move(self._against(zero, active, outcome, depth_mm, surface), motion)
        self._zero = reference
        return motion

    def _against(
        self, reference: Reference, active: ActiveModel, outcome: Projection, depth_mm: FloatArray, surface: FloatArray
    ) -> Motion:
        """Tell a surface as motion from a zero."""
        motion_mm = reference.regions_mm - depth_mm
        regions = active.regions
        cells, shape = regions.cells, (regions.rows, regions.columns)
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

    def _reference(self, active: ActiveModel, outcome: Projection, surface: FloatArray, rays: FloatArray) -> Reference:
        """Return the zero of motion; a new one is taken from the last frames together."""
        if not self._learner.is_zero_due:
            return self._learner.reference(active, outcome.coefficients, surface)
        settled = self._recent.settled(active, outcome)
        return self._learner.reference(active, settled, _surface(rays, active.node_depth_mm(settled)))


def _surface(rays: FloatArray, depth_mm: FloatArray) -> FloatArray:
    """Push rays of the nodes out to their depth; the last nodes lie a pixel of the grid beyond the markers."""
    return vertices_mm(end_at_markers(rays, NODE_ROWS, NODE_COLUMNS, MARKERS_BETWEEN_NODES), depth_mm)
