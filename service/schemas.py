"""What goes over HTTP, in and out: strict, bounded and printable.

Lengths are mm, times RFC 3339 UTC, motion is positive for inhale. Requests refuse unknown keys, wrong types, NaN and
anything out of bounds; the bounds here are those of any site, and the site's own settings may be narrower.
"""

from typing import Annotated, Literal

from pydantic import AwareDatetime, ConfigDict, Field, StringConstraints, model_validator

from engine.errors import InvalidValueError
from engine.polygons import MAX_REGIONS, MAX_VERTICES, MIN_VERTICES, NAME_PATTERN, NamedRegion
from engine.stages.regions import MIN_PART_ROWS
from service.live_messages import LiveBreath, LiveBreathHold, LiveWindow
from service.schema_base import Answer, Identifier, Name, Operator, Request, SourceText, broken
from service.window_schemas import Window

SessionStatus = Literal["created", "running", "ended", "stopped", "failed", "interrupted"]
CalibrationKind = Literal["uploaded", "device registration"]


class RecordingSource(Request):
    """A recording inside one of the folders that the site allows."""

    kind: Literal["recording"]
    path: SourceText = Field(
        description="Absolute, or relative to one of the allowed folders", examples=["demo/recording.oni"]
    )
    player: Literal["openni", "reader", "auto"] = Field(
        default="auto",
        description="The OpenNI2 runtime in real time, our own reader in real time, or the first that works",
    )


class DeviceSource(Request):
    """A live camera through the OpenNI2 runtime."""

    kind: Literal["device"]
    uri: SourceText | None = Field(default=None, description="As listed by /devices; the first one when left out")


Source = Annotated[RecordingSource | DeviceSource, Field(discriminator="kind")]


GridRow = Annotated[float, Field(ge=-0.5, le=349.5)]
GridVertex = Annotated[list[GridRow], Field(min_length=2, max_length=2)]


class Region(Request):
    """A simple polygon on the region's grid of 350 rows by 200 columns, reported under its name."""

    name: Annotated[str, StringConstraints(pattern=NAME_PATTERN)] = Field(examples=["belly"])
    vertices: list[GridVertex] = Field(
        min_length=MIN_VERTICES,
        max_length=MAX_VERTICES,
        description="[row, column] around it, pixel centres at integers; at least 25 pixels large, edges do not cross",
        examples=[[[220.0, 40.0], [220.0, 160.0], [320.0, 100.0]]],
    )

    @model_validator(mode="after")
    def _is_a_region(self) -> "Region":
        try:
            NamedRegion(name=self.name, vertices=tuple((row, column) for row, column in self.vertices))
        except InvalidValueError as error:
            field = "name" if error.field == "region" else "vertices"
            raise broken(field, error.value.strip("'"), error.bound) from error
        return self


class SplitLine(Request):
    """The line between thorax and abdomen: the rows where it crosses the patient's right and left edge of the grid."""

    right_row: float = Field(ge=MIN_PART_ROWS, le=350 - MIN_PART_ROWS, examples=[150.0])
    left_row: float = Field(ge=MIN_PART_ROWS, le=350 - MIN_PART_ROWS, examples=[160.0])


class Regions(Request):
    """What motion is reported of, besides the whole and the cells of the grid."""

    named: list[Region] = Field(default=[], max_length=MAX_REGIONS)
    split: SplitLine | None = Field(default=None, description="Between rows 174 and 175 when left out")
    extra_markers: bool = Field(
        default=False, description="Two more stickers at the costal margin mark the split, if they are seen"
    )

    @model_validator(mode="after")
    def _has_each_name_once(self) -> "Regions":
        names = [region.name for region in self.named]
        for name in names:
            if names.count(name) > 1:
                raise broken("named", name, "regions of different names")
        return self


class SessionRequest(Request):
    """A new session: who is treated, by which plan, watched by which camera, gated by which window."""

    patient_reference: Name = Field(description="The clinic's own pseudonymous reference; no name, no birth date")
    plan_id: Name
    fraction_id: Name
    fraction_number: int | None = Field(default=None, ge=1, le=200)
    operator: Operator = ""
    source: Source
    calibration_id: Identifier | None = Field(
        default=None,
        description="Left out only for a live camera: then its own registration is used, and the session says so",
    )
    window: Window
    regions: Regions = Field(default=Regions())
    model_id: Identifier | None = Field(
        default=None,
        description="Begin with this model of an earlier session of the same patient and calibration, instead of "
        "learning one; it is compared with the patient first, and the reference has to be set by a person",
    )

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "patient_reference": "P-0001",
                    "plan_id": "PLAN-1",
                    "fraction_id": "FX-1",
                    "fraction_number": 1,
                    "operator": "A. Therapist",
                    "source": {"kind": "recording", "path": "demo/recording.oni", "player": "auto"},
                    "calibration_id": "0" * 32,
                    "window": {
                        "signal": "whole",
                        "lower_mm": -1.0,
                        "upper_mm": 3.0,
                        "hysteresis_mm": 0.2,
                        "dwell_ms": 200.0,
                    },
                }
            ]
        }
    )


class OperatorRequest(Request):
    """Who asks."""

    operator: Operator = ""


class RetrainRequest(OperatorRequest):
    """Who asks for a new model, and whether its zero is the present one's."""

    keeps_reference: bool = Field(
        default=True,
        description="Carry the zero of motion over to the new model, or refuse that model; when false the zero is "
        "given up, and nobody may arm until a person has set it again",
    )


class SurfaceMesh(Answer):
    """The surface of one frame: points of the depth camera's frame, x right, y down, z away from the camera."""

    frame_index: int
    timestamp_us: int
    rows: int
    columns: int
    volume_l: float | None = Field(description="Against the reference; positive is more")
    vertices_mm: list[list[float]] = Field(description="[x, y, z], row by row from superior right")
    triangles: list[list[int]] = Field(
        description="Three vertices each, counter-clockwise as the camera sees them: normals point out of the patient"
    )


class GateView(Answer):
    """Where the gate of a running session stands."""

    state: Literal["disarmed", "hold", "dwell", "beam_on", "fault"]
    is_armed: bool
    hold_reason: str | None
    hold_text: str | None
    hold_detail: str = Field(default="", description="More about why, with figures")
    operator_hold: str | None = Field(default=None, description="Who holds the beam by hand")
    line_on: bool


class TrainingView(Answer):
    """How far the learning of the patient's motion has come; share runs from 0 to 1."""

    frames: int
    cycles: int
    seconds: float
    share: float
    note: str
    amplitude_mm: float | None = Field(default=None, description="How deep the patient has breathed so far")
    shift_mm: float | None = Field(default=None, description="How far the region has moved since the gathering began")


class LikenessView(Answer):
    """How far the patient of today is from the stored model that the session began with."""

    is_accepted: bool
    refusal: str | None = Field(description="Why the model is not used on this patient; a new one is learned then")
    frames: int
    explained_share: float = Field(description="Share of the frames that the model explains, 0 to 1")
    residual_mm: float | None = Field(description="Median of the largest mean misfit of a cell; null: none explained")
    shift_mm: list[float] = Field(description="From the training to today: x right, y down, z away from the camera")
    tilt_deg: float
    shape_mm: float = Field(description="Root mean square difference that shift and tilt do not explain")


class LatencyView(Answer):
    """From the camera taking a frame to the beam line told [ms]."""

    p50_ms: float | None
    p99_ms: float | None
    max_ms: float | None = None


class Summary(Answer):
    """Figures of a session so far, from what is in the database."""

    frames: int
    missed_frames: int = Field(description="Frames the camera counted and that never came")
    lost: int = Field(description="Frames that could not be measured")
    duty_cycle: float | None = Field(description="Share of armed frames with the line on; null when never armed")
    transitions: int
    latency: LatencyView


class Session(Answer):
    """A session, as it stands."""

    id: Identifier
    status: SessionStatus
    status_detail: str
    patient_reference: str
    plan_id: str
    fraction_id: str
    fraction_number: int | None
    operator: str
    source: Source
    calibration_id: Identifier
    calibration: CalibrationKind = Field(
        default="uploaded", description="`device registration`: nothing was measured for this camera"
    )
    calibration_warning: str | None = Field(default=None, description="To be shown beside every result")
    source_warning: str | None = Field(default=None, description="Where a recording gates a real line: to be shown")
    window: Window
    regions: Regions = Field(default=Regions())
    model_id: Identifier | None = Field(default=None, description="The stored model it begins with")
    rt_plan_id: Identifier | None = Field(default=None, description="The RT Plan it was prepared from")
    is_simulated_beam: bool
    created_at: AwareDatetime
    started_at: AwareDatetime | None
    ended_at: AwareDatetime | None


class SessionDetail(Session):
    """A session with its gate, its learning and its figures."""

    gate: GateView | None = Field(description="null unless running")
    measurement_state: Literal["training", "measuring", "lost"] | None
    training: TrainingView | None
    active_model_id: Identifier | None
    has_reference: bool | None = Field(
        default=None, description="Whether motion has a zero to arm with; null unless running"
    )
    gate_window: LiveWindow | None = Field(
        default=None, description="As the gate judges by it: settled in mm or l, and corrected; null unless running"
    )
    breath: LiveBreath | None = Field(default=None, description="null while nothing is measured")
    breath_hold: LiveBreathHold | None = Field(default=None, description="null where the window has none")
    likeness: LikenessView | None = Field(
        default=None, description="null without a stored model, and until the patient was looked at for long enough"
    )
    summary: Summary


class SessionPage(Answer):
    """Newest first; `next_cursor` is null on the last page."""

    items: list[Session]
    next_cursor: str | None


class Transition(Answer):
    """One change of the gate, as audited; the `_ns` are host monotonic time."""

    audit_sequence: int
    at: AwareDatetime
    frame_index: int | None
    from_state: str
    to_state: str
    reason: str | None
    operator: str | None
    detail: str
    captured_us: int | None
    captured_ns: int | None = Field(default=None, description="The frame's capture on the host's clock")
    received_ns: int | None
    decided_ns: int | None
    asserted_ns: int | None
    latency_ms: float | None = Field(
        default=None, description="From capture to the line told; null where no frame was the cause"
    )
    number: int | None = Field(default=None, description="Its own in the session's journal, rising; not without gaps")
    recovered: bool = Field(
        default=False, description="Written down by the next start: the process was killed before it could"
    )


class TransitionPage(Answer):
    """Oldest first."""

    items: list[Transition]
    next_cursor: str | None


class Device(Answer):
    """A camera the OpenNI2 runtime sees."""

    uri: str
    name: str


class DeviceList(Answer):
    """Cameras, and why there are none when the runtime is missing."""

    is_runtime_available: bool
    detail: str
    items: list[Device]
