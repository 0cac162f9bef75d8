"""The values of a frame, from the camera to the gate.

Each is frozen and its arrays are read-only, so stages and threads can share them.
``motion_mm = reference depth - current depth``: positive is anterior, towards the camera, inhale.
"""

import enum
import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from engine.core.breath import Breath
from engine.core.replacing import replace
from engine.core.sentences import say

FloatArray = npt.NDArray[np.floating]
BoolArray = npt.NDArray[np.bool_]
DepthImage = npt.NDArray[np.uint16]
ColorImage = npt.NDArray[np.uint8]

THIN_DEPTH_PX, THIN_COLOR_PX = 4, 16
"""Steps of the rows and columns of the pictures' thinned views."""
ROI_ROWS = 350
ROI_COLUMNS = 200
NODE_STEP = 25
"""Grid pixels between two nodes, where the region is mapped exactly and the surface's vertices are reported."""
NODE_ROWS = ROI_ROWS // NODE_STEP + 1
NODE_COLUMNS = ROI_COLUMNS // NODE_STEP + 1
NO_DIGEST = {"is_in_digest": False}
"""Of a field left out of a tape's digests, as earlier tapes lack it; the gate's decisions cover its use."""


def frozen(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return ``array`` with its writeable flag cleared (no copy)."""
    array.setflags(write=False)
    return array


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RgbdFrame:
    """One depth frame with the colour frame nearest to it in time.

    Attributes
    ----------
    index
        Ordinal of the depth frame in its source, from 0, without gaps.
    device_index
        The device's own frame counter; a step of more than one is a loss.
    missed_frames
        Depth frames that the device counted since the frame before this one and did not deliver.
    timestamp_us, color_timestamp_us
        Device time of the depth and of the colour frame [us].
    received_ns
        Host monotonic time at which the depth frame was received [ns].
    queue_empty_ns
        Host monotonic time at which the driver was last known to have no frame waiting, up to the receipt of this one
        [ns]; None where the source cannot tell, as that of a recording.
    depth_mm
        Depth along the optical axis of the depth camera [mm], shape (H, W), uint16; 0 is "no reading".
    color
        RGB, shape (H', W', 3), uint8.
    """

    index: int
    device_index: int
    missed_frames: int = 0
    timestamp_us: int
    color_timestamp_us: int
    received_ns: int
    queue_empty_ns: int | None = None
    depth_mm: DepthImage
    color: ColorImage

    def __post_init__(self) -> None:
        """Check the shapes once, where the frame is made."""
        if self.depth_mm.ndim != 2 or self.depth_mm.dtype != np.uint16:
            msg = f"depth must be (H, W) uint16, not {self.depth_mm.shape} {self.depth_mm.dtype}"
            raise ValueError(msg)
        if self.color.ndim != 3 or self.color.shape[2] != 3 or self.color.dtype != np.uint8:
            msg = f"colour must be (H, W, 3) uint8, not {self.color.shape} {self.color.dtype}"
            raise ValueError(msg)
        frozen(self.depth_mm)
        frozen(self.color)

    @property
    def pair_gap_us(self) -> int:
        """How far apart in time depth and colour are [us]."""
        return abs(self.timestamp_us - self.color_timestamp_us)


class ThinViews(NamedTuple):
    """What later checks read of a frame's pictures, until the next frame.

    Attributes
    ----------
    depth_mm
        Every `THIN_DEPTH_PX`-th row and column of the depth picture.
    color
        Every `THIN_COLOR_PX`-th of the colour picture.
    """

    depth_mm: DepthImage
    color: ColorImage


class LostReason(enum.StrEnum):
    """Why a frame could not be measured; the codes of `HoldReason` where both know the cause."""

    MARKER_LOST = "marker_lost"
    LAYOUT_CHANGED = "layout_changed"
    COVERAGE_LOW = "coverage_low"
    RESIDUAL_HIGH = "residual_high"
    SURFACE_CHANGED = "surface_changed"
    CAMERA_MOVED = "camera_moved"
    VALUE_INVALID = "value_invalid"
    FRAME_FROZEN = "frame_frozen"
    FRAME_TORN = "frame_torn"


class Mover(enum.StrEnum):
    """What moved, of couch and camera; `EITHER` where couch and floor are not both seen."""

    COUCH = "couch"
    CAMERA = "camera"
    EITHER = "camera_or_couch"

    @property
    def text(self) -> str:
        """The words for a person."""
        return {
            Mover.EITHER: say("camera or couch"),
            Mover.COUCH: say("the couch"),
            Mover.CAMERA: say("the camera"),
        }[self]


class RoomChange(NamedTuple):
    """A movement of couch or camera since the reference; ``by_mm`` is the largest change of depth at a marker."""

    mover: Mover
    by_mm: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Lost:
    """A measurement that could not be made, and why; ``detail`` is for a person.

    ``moved`` is set where couch or camera have moved.
    """

    reason: LostReason
    detail: str
    moved: RoomChange | None = field(default=None, metadata=NO_DIGEST)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Markers:
    """The four dot markers that bound the region.

    Attributes
    ----------
    centers_px
        Sub-pixel centres in the colour picture [px], pixel centres at integers, x then y, shape (4, 2). Order:
        superior right, superior left, inferior left, inferior right (the patient's right and left), which are the
        corners (0, 0), (0, 199), (349, 199), (349, 0) of the ROI grid as (row, column).
    """

    centers_px: FloatArray

    def __post_init__(self) -> None:
        """Check the shape once."""
        if self.centers_px.shape != (4, 2):
            msg = f"four centres of two coordinates expected, not {self.centers_px.shape}"
            raise ValueError(msg)
        self.centers_px.setflags(write=False)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class RoiDepth:
    """Depth on the anatomically consistent grid: row 0 superior, column 0 patient right.

    Attributes
    ----------
    depth_mm
        Depth [mm], shape (350, 200), float32, or of every ``stride_px``-th row and column of that; meaningless where
        ``valid`` is false.
    valid
        Whether the sensor saw that point, same shape.
    """

    depth_mm: FloatArray
    valid: BoolArray
    stride_px: int = 1

    def __post_init__(self) -> None:
        """Make both arrays read-only."""
        self.depth_mm.setflags(write=False)
        self.valid.setflags(write=False)

    def thinned(self, stride_px: int) -> "RoiDepth":
        """Return the same at every ``stride_px``-th row and column; a multiple of the present stride."""
        step = stride_px // self.stride_px
        if step == 1:
            return self
        every = (slice(None, None, step),) * 2
        depth_mm, valid = np.ascontiguousarray(self.depth_mm[every]), np.ascontiguousarray(self.valid[every])
        return RoiDepth(depth_mm=depth_mm, valid=valid, stride_px=stride_px)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Projection:
    """A frame as the motion model explains it.

    Attributes
    ----------
    beta
        Coefficients of the components [mm], shape (k,).
    coefficients
        ``beta`` and, behind it, those of the smooth correction that the components do not span, shape (k + e,).
    residual_mm
        Largest mean misfit of any visible cell of the region [mm], less what a sensor noisier than the usual adds to
        it: the best indicator that this is still the patient of the training.
    valid_share
        Share of the ROI the sensor saw, 0 to 1.
    inlier_share
        Share of the seen pixels that the model explains, 0 to 1; a hand or a sheet takes pixels out.
    is_seen
        Whether each sampled point of the grid has a reading that the model explains, shape (88, 50).
    """

    beta: FloatArray
    coefficients: FloatArray
    residual_mm: float
    valid_share: float
    inlier_share: float
    is_seen: BoolArray = field(default_factory=lambda: np.zeros((0, 0), dtype=np.bool_), metadata=NO_DIGEST)

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in (self.beta, self.coefficients, self.is_seen):
            array.setflags(write=False)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class SeenShares:
    """Share of the area of each region that was seen and fits the model, 0 to 1; NaN or absent where it is unknown.

    Attributes
    ----------
    whole, thorax, abdomen
        Of the wide regions.
    cells
        Of each cell of the region grid, shape (rows, columns).
    points, named
        Of the requested points with their surroundings, shape (p,), and of the named regions, shape (q,).
    """

    whole: float = math.nan
    thorax: float = math.nan
    abdomen: float = math.nan
    cells: FloatArray = field(default_factory=lambda: np.empty((0, 0)))
    points: FloatArray = field(default_factory=lambda: np.empty(0))
    named: FloatArray = field(default_factory=lambda: np.empty(0))

    def __post_init__(self) -> None:
        """Make the arrays read-only."""
        for array in (self.cells, self.points, self.named):
            array.setflags(write=False)

    def unseen_cells(self, min_share: float) -> tuple[tuple[int, int], ...]:
        """Return row and column of every cell of which less than ``min_share`` was seen, row by row."""
        rows, columns = np.nonzero(~(self.cells >= min_share))
        return tuple(zip(rows.tolist(), columns.tolist(), strict=True))


UNKNOWN_SHARES = SeenShares()


@dataclass(frozen=True, slots=True, kw_only=True)
class PhaseLag:
    """How much later one region moves than another, over the last cycles.

    Attributes
    ----------
    first, second
        The regions' names; the first moves later if the lag is positive.
    lag_s, lag_deg
        The lag [s] and as a part of the cycle [deg, above -180 to 180]; None when it cannot be determined.
    period_s
        Length of a cycle [s]; None when there is none.
    confidence
        How well the two agree once the lag is undone, the correlation, up to 1; None when it was not computed.
    note
        Why it cannot be determined; empty otherwise.
    """

    first: str
    second: str
    lag_s: float | None = None
    lag_deg: float | None = None
    period_s: float | None = None
    confidence: float | None = None
    note: str = ""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Motion:
    """What was measured on one frame; motion is positive towards the camera.

    Attributes
    ----------
    regions_mm, regions_depth_mm
        Mean motion and mean depth of each cell of the region grid [mm], shape (rows, columns); NaN where a cell lies
        outside of what the model covers.
    points_mm
        Motion at the requested grid points [mm], shape (p,).
    named_mm
        Motion of the named regions [mm] in the order they were given, shape (q,).
    volume_l
        Volume against the reference [l]; positive is more.
    lags
        Phase lags between regions, thorax against abdomen first; worked out about once a second.
    surface_mm
        The region's surface in the depth camera's frame [mm] at its nodes, from superior right row by row, (n, 3).
    split_rows
        Where the line between thorax and abdomen crosses column 0 and column 199 of the grid [row].
    seen, reference_seen
        How much of each region was seen in this frame, and when the reference was set: motion is the difference of
        both. The model extrapolates the rest.
    """

    whole_mm: float
    thorax_mm: float
    abdomen_mm: float
    volume_l: float
    regions_mm: FloatArray
    regions_depth_mm: FloatArray
    points_mm: FloatArray
    projection: Projection
    named_mm: FloatArray = field(default_factory=lambda: frozen(np.empty(0)))
    lags: tuple[PhaseLag, ...] = ()
    surface_mm: FloatArray = field(default_factory=lambda: frozen(np.empty((0, 3))))
    split_rows: tuple[float, float] | None = None
    seen: SeenShares = field(default=UNKNOWN_SHARES, metadata=NO_DIGEST)
    reference_seen: SeenShares = field(default=UNKNOWN_SHARES, metadata=NO_DIGEST)


class BodyPosition(NamedTuple):
    """Rigid movement of the patient since the reference, by the region's surface; breathing is taken off.

    Attributes
    ----------
    measured_us
        Device time of the frame it was measured in [us]: it stands while later frames see too little of the surface.
    height_mm
        In the middle of the region, positive towards the camera.
    tilt_deg, roll_deg
        About the axis across the body, positive where the inferior end rises; about the long axis, positive where the
        patient's left side rises.
    redistributed_mm
        Root mean square of what is shifted between thorax and abdomen, other than in the training.
    """

    measured_us: int
    height_mm: float
    tilt_deg: float
    roll_deg: float
    redistributed_mm: float = 0.0


class Evidence(NamedTuple):
    """Which checks of the second estimate could compare a frame with the reference; a check that cannot finds nothing.

    Attributes
    ----------
    surface
        The region's surface was seen, and compared with breathing and a rigid movement.
    color
        Half of the region has a colour, in this frame and at the reference.
    camera
        Enough of couch and floor is seen, in the last frames and once since the reference.
    colored_share
        Share of the region whose colour was compared, 0 to 1.
    """

    surface: bool
    color: bool
    camera: bool
    colored_share: float = 1.0


class MeasurementState(enum.StrEnum):
    """What the pipeline is doing with frames now."""

    TRAINING = "training"
    MEASURING = "measuring"
    LOST = "lost"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Measurement:
    """The outcome of one frame: exactly one a frame, in order.

    ``motion`` is set if and only if ``state`` is measuring; ``lost`` if and only if it is lost. ``markers`` are those
    of this frame when they were found, also while training. ``breaths`` say where the breath stands, one a signal that
    is watched; none before there is a motion. ``position`` is how the patient has moved as a whole; None where that is
    unknown. ``evidence`` is what the second estimate could compare; None unless measured. ``queue_empty_ns`` is that of
    the frame. ``doubt`` is set where the frame is measured, and the motion may be that of the camera or the couch: the
    gate takes such a frame for a lost one (`as_gated`).
    """

    frame_index: int
    timestamp_us: int
    received_ns: int
    measured_ns: int
    missed_frames: int
    state: MeasurementState
    motion: Motion | None = None
    lost: Lost | None = None
    markers: Markers | None = None
    training: "TrainingProgress | None" = None
    breaths: tuple[Breath, ...] = ()
    position: BodyPosition | None = field(default=None, metadata=NO_DIGEST)
    evidence: Evidence | None = field(default=None, metadata=NO_DIGEST)
    queue_empty_ns: int | None = field(default=None, metadata=NO_DIGEST)
    doubt: Lost | None = field(default=None, metadata=NO_DIGEST)

    @property
    def as_gated(self) -> "Measurement":
        """The measurement as the gate and its supervision take it: lost where it is doubted."""
        if self.doubt is None:
            return self
        return replace(
            self,
            state=MeasurementState.LOST,
            motion=None,
            lost=self.doubt,
            doubt=None,
            breaths=(),
            position=None,
            evidence=None,
        )

    @property
    def reason(self) -> Lost | None:
        """Why it is lost, or doubted; None where neither."""
        return self.lost or self.doubt


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainingProgress:
    """Progress of gathering training frames; ``share`` runs from 0 to 1.

    ``amplitude_mm`` is the breathing's amplitude so far, ``shift_mm`` the shift of the whole region since the gathering
    began; None until they are measured.
    """

    frames: int
    cycles: int
    seconds: float
    share: float
    note: str = ""
    amplitude_mm: float | None = None
    shift_mm: float | None = None
