"""Settings of the measurement: cells of the region, reported signals, and bounds of a usable frame."""

from dataclasses import dataclass, field

from engine.core.bounds import check_number
from engine.core.breath import WHOLE, SignalChoice
from engine.motion.learning.patient_match import PatientMatchLimits
from engine.motion.learning.position_fit import MARKER_PLACEMENT_MM
from engine.motion.learning.trainer import TrainingSettings
from engine.motion.named_regions import NamedRegion
from engine.motion.stages.regions import WIDE, RegionLayout, horizontal_split
from engine.motion.tracking.breath_tracker import check_signals

MARKER_PLACEMENT_BOUNDS = (0.5, 50.0)
"""Bounds of `PipelineSettings.marker_placement_mm` [mm]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PipelineSettings:
    """Settings of the measurement, and the bounds beyond which a frame is lost.

    Attributes
    ----------
    cell_px
        Side of a region's cell on the grid [px].
    thorax_rows
        Rows of the grid above this are thorax, the others abdomen.
    split
        The line between thorax and abdomen where it is not along a row: the rows where it crosses column 0 and 199.
    extra_markers
        Whether two stickers at the costal margin mark that line; it is then fixed with the first model.
    points
        Grid points (row, column) to report singly.
    named
        Polygons on the grid to report, each under its name.
    breath_signals
        Signals whose breathing is monitored, at most four.
    superior_px
        Direction towards the patient's head in the picture, as in `engine.motion.stages.markers.MarkerSearch`.
    max_pair_gap_ms
        Largest time between depth and colour picture [ms]: markers of an older picture do not give the present region.
    max_layout_change
        Largest relative change of a distance between two markers; beyond, the layout has changed.
    min_valid_share, min_inlier_share
        Least share of the region with a reading, and of its readings that the model explains, 0 to 1.
    max_residual_mm
        Largest residual of a measured frame [mm].
    most_noise_mm
        Noise of a training from which the camera is not as its kind should be: such a model arms no gate. None for any.
    marker_placement_mm
        How exactly the markers are put back in another fraction, standard deviation of a common shift of all [mm].
    likeness
        Limits of the match between a stored model and the patient.
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
    most_noise_mm: float | None = None
    marker_placement_mm: float = MARKER_PLACEMENT_MM
    training: TrainingSettings = field(default_factory=TrainingSettings)
    likeness: PatientMatchLimits = field(default_factory=PatientMatchLimits)

    def __post_init__(self) -> None:
        """Check the grid settings and the signals, and the placement of the markers."""
        self.layout()
        check_number("marker_placement_mm", self.marker_placement_mm, *MARKER_PLACEMENT_BOUNDS)
        check_signals(self.breath_signals)

    def layout(self, marked_split: tuple[float, float] | None = None) -> RegionLayout:
        """Return the regions that motion is averaged over; a line marked by stickers overrides the configured one."""
        split = marked_split or self.split or horizontal_split(self.thorax_rows)
        return RegionLayout(cell_px=self.cell_px, split=split, points=self.points, named=self.named)

    def lag_pairs(self) -> tuple[tuple[str, int, str, int], ...]:
        """Return the pairs for phase lags: names, and positions among whole, thorax, abdomen, points and named."""
        named_from = len(WIDE) + len(self.points)
        named = ((region.name, position, WIDE[0], 0) for position, region in enumerate(self.named, start=named_from))
        return ((WIDE[1], 1, WIDE[2], 2), *named)
