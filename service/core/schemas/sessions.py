"""Schemas of sessions.

Lengths are mm, times RFC 3339 UTC, motion is positive for inhale. Requests with unknown keys, wrong types, NaN or
values out of bounds are refused. The bounds here hold for all sites; a site's settings may be narrower.
"""

from collections.abc import Iterable
from typing import Annotated, Literal, Self

from pydantic import AwareDatetime, ConfigDict, Field, SecretStr, StringConstraints, model_validator

from engine.core.errors import InvalidValueError
from engine.gating import MAX_MOTION_MM
from engine.motion import MAX_REGIONS, MAX_VERTICES, MIN_PART_ROWS, MIN_VERTICES, NAME_PATTERN, NamedRegion
from service.core.schemas.base import Answer, Identifier, Name, Operator, Request, SourceText, broken
from service.core.schemas.live_messages import (
    LiveAlarm,
    LiveBreath,
    LiveBreathHold,
    LiveCheck,
    LiveDegree,
    LivePositionCheck,
    LiveReference,
    LiveWindow,
)
from service.core.schemas.sentences import Text
from service.core.schemas.windows import Window

SessionStatus = Literal["created", "running", "ended", "stopped", "failed", "interrupted"]
CalibrationKind = Literal["uploaded", "device registration", "device calibration"]
HeadSide = Literal["top", "bottom", "left", "right"]
HEAD_WORDS = "Side of the camera's picture at which the patient's head lies"
CONTINUES = (
    "An earlier session of the same fraction that is over: its beam-on time is kept and shown with the new session's."
    " Nothing else is taken over: the gate is not armed, and a person confirms the reference again"
)
GridRow = Annotated[float, Field(ge=-0.5, le=349.5)]
GridVertex = Annotated[list[GridRow], Field(min_length=2, max_length=2)]
ReferenceMoment = Literal["end_exhale", "end_inhale", "now"]


class RecordingSource(Request):
    """A recording in one of the site's allowed folders."""

    kind: Literal["recording"]
    path: SourceText = Field(
        description="Absolute path, or relative to an allowed folder", examples=["demo/recording.oni"]
    )
    player: Literal["openni", "reader", "repeated", "auto"] = Field(
        default="auto",
        description="The OpenNI2 runtime, Tidegate's reader, or the first of them that works; all in real time."
        " `repeated`: by the reader, again from the beginning at the end until the session is stopped; the signal jumps"
        " at the seam",
    )


class DeviceSource(Request):
    """A live camera."""

    kind: Literal["device"]
    uri: SourceText | None = Field(
        default=None, description="URI as listed by /devices; the first camera when left out"
    )


Source = Annotated[RecordingSource | DeviceSource, Field(discriminator="kind")]


class Region(Request):
    """A simple polygon on the region's grid of 350 rows by 200 columns, reported under its name."""

    name: Annotated[str, StringConstraints(pattern=NAME_PATTERN)] = Field(examples=["belly"])
    vertices: list[GridVertex] = Field(
        min_length=MIN_VERTICES,
        max_length=MAX_VERTICES,
        description="Vertices [row, column], pixel centres at integers; area of at least 25 pixels, edges do not cross",
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
    """The regions for which motion is reported, in addition to the whole and the cells of the grid."""

    named: list[Region] = Field(default=[], max_length=MAX_REGIONS)
    split: SplitLine | None = Field(default=None, description="Between rows 174 and 175 when left out")
    extra_markers: bool = Field(
        default=False,
        description="Detect the split from two additional markers at the costal margin, if they are visible",
    )

    @model_validator(mode="after")
    def _has_each_name_once(self) -> "Regions":
        names = [region.name for region in self.named]
        for name in names:
            if names.count(name) > 1:
                raise broken("named", name, "regions of different names")
        return self


class SessionRequest(Request):
    """A new session: patient, plan, camera or recording, and gating window."""

    patient_reference: Name = Field(description="The clinic's pseudonymous reference; no name, no birth date")
    plan_id: Name
    fraction_id: Name
    fraction_number: int | None = Field(default=None, ge=1, le=200)
    operator: Operator = ""
    source: Source
    calibration_id: Identifier | None = Field(
        default=None,
        description="May be left out for a live camera: then its built-in registration is used, and "
        "the session carries a warning",
    )
    window: Window
    regions: Regions = Field(default=Regions())
    model_id: Identifier | None = Field(
        default=None,
        description="Use this model of an earlier session of the same patient and calibration instead"
        " of training one; it is compared with the patient first, and a person must set "
        "the reference",
    )
    head_direction: HeadSide | None = Field(
        default=None,
        description=f"{HEAD_WORDS}; if left out, only windows on `whole` or `volume` can be armed",
    )
    continues: Identifier | None = Field(default=None, description=CONTINUES)

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
    """The body of a call that names only the operator."""

    operator: Operator = ""


class AcknowledgeRequest(OperatorRequest):
    """The person who acknowledges, and which alarms."""

    alarms: list[Annotated[int, Field(ge=1, le=2**53)]] | None = Field(
        default=None,
        min_length=1,
        max_length=64,
        description="Numbers of the alarms that the person has seen; all active ones, the latched fault included, if"
        " left out",
        examples=[[3]],
    )


class WindowRequest(OperatorRequest):
    """Another window for a session that runs, with the conditions of the present one and other numbers."""

    window: Window = Field(
        description="Conditions of the same kinds, on the same signals, in the same order as the session's window"
    )
    reason: str = Field(
        default="",
        max_length=1_000,
        description="Required if the window reaches beyond the fraction's first armed one by more than the budget of"
        " references: from a person who may arm. Required always where the site wants countersignatures",
        examples=["the plan was adapted"],
    )


class ArmRequest(OperatorRequest):
    """The operator who arms, and the head direction that the operator confirms."""

    head_direction: HeadSide | None = Field(
        default=None,
        description=f"{HEAD_WORDS}, as the operator sees it; must be the session's. Required unless the window is on"
        " `whole` or `volume` only",
    )
    state: str | None = Field(
        default=None,
        pattern=r"^[0-9a-f]{32}$",
        description="The `state` of the `GET .../arming` that was looked at: refused if window, reference, model or"
        " head direction is another by now. Left out with `If-Match`, it is the one of that ETag. One of the two is"
        " required in clinical mode",
    )
    reason: str = Field(
        default="",
        max_length=1_000,
        description="Why conditions joined by `or` are armed: required of a person; a program cannot arm such a window",
    )


class ReferenceRequest(OperatorRequest):
    """The person who sets the reference, the moment of the breath, and what that person was shown."""

    at: ReferenceMoment = Field(
        default="end_exhale",
        description="`end_exhale` and `end_inhale`: the mean position at these moments of the last breaths, as in the"
        " session's `reference_proposals`; `now`: the present position, for a breath that is held",
    )
    level_seen: float | None = Field(
        default=None,
        ge=-MAX_MOTION_MM,
        le=MAX_MOTION_MM,
        description="The level that was shown, in the gated signal's unit: refused if it is another by now by more than"
        " 0.5 mm (0.05 l)",
    )
    move_seen_mm: float | None = Field(
        default=None,
        ge=0.0,
        le=MAX_MOTION_MM,
        description="The movement of couch or camera since the last reference that was shown (`lost.moved_mm` of the"
        " stream), which this reference accepts: required while there is one, refused if it is another by now by more"
        " than 0.5 mm",
    )
    reason: str = Field(
        default="",
        max_length=200,
        description="Required for an amplitude window where the level lies between 15 and 85 % of the learned breath,"
        " and beyond `max_reference_distance_mm` from the fraction's first reference; there the person also needs the"
        " permission `gate.arm`",
    )
    setup_confirmed: bool = Field(
        default=False,
        description="The person has seen that the stickers are on the skin or on a tight shirt, and that nothing else"
        " covers the chest. Required once a session in clinical mode, and kept in the audit",
    )


class PositionCheckRequest(OperatorRequest):
    """The person who signs the patient's position, and which comparison that person was shown."""

    reference_number: int = Field(
        ge=1,
        le=2**31,
        description="As in the session's `position_check`: refused if another reference is in use by now",
        examples=[1],
    )
    reason: str = Field(
        default="",
        max_length=200,
        description="Required where the position is beyond the tolerance or not determined, such as by which other"
        " means it was checked; there the person also needs the permission `gate.arm`",
    )


class CountersignRequest(OperatorRequest):
    """What a second person countersigns; with name and password if another person is logged in at this page."""

    state: str = Field(
        pattern=r"^[0-9a-f]{32}$",
        description="The `state` of the `GET .../arming` that the person looked at: refused if it is another by now",
    )
    name: str | None = Field(
        default=None,
        min_length=1,
        max_length=80,
        description="The second person, with `password`; left out, it is the caller",
        examples=["B. Therapist"],
    )
    password: SecretStr | None = Field(default=None, min_length=1, max_length=1_000)

    @model_validator(mode="after")
    def _is_whole(self) -> Self:
        if (self.name is None) != (self.password is None):
            raise broken("name", self.name or "left out", "given together with password")
        return self


class ReferenceProposalView(Answer):
    """A position of the last breaths that a person may make the reference."""

    at: Literal["end_exhale", "end_inhale"]
    signal: str = Field(description="The gated signal")
    unit: Literal["mm", "l"]
    level: float = Field(description="Against the present reference")
    scatter: float = Field(description="Standard deviation over the breaths")
    breaths: int = Field(description="Breaths that it is the mean of, 2 to 5")
    percent: float | None = Field(
        description="Its place in the learned breath: 0 end of exhale, 100 end of inhale; null if that is not known"
    )
    distance: str | None = Field(
        default=None, description="How far it lies from the fraction's first reference; null without one"
    )
    distance_mm: float | None = Field(default=None, description="The same as a number; null if it is not known")
    is_beyond: bool = Field(
        default=False, description="Beyond `max_reference_distance_mm`, or at an unknown distance: a reason is required"
    )
    position: list[LiveDegree] = Field(
        default=[],
        description="Where it lies against the plan's position; empty in the plan's first fraction, while the gate is"
        " armed, for the end of inhale, and where nothing can be compared",
    )


class RetrainRequest(OperatorRequest):
    """The operator who requests a new model, and whether the reference is transferred to it."""

    keeps_reference: bool = Field(
        default=True,
        description="Transfer the reference to the new model, or refuse the model; if false, the "
        "reference is discarded and arming is refused until a person has set it again",
    )


class SurfaceMesh(Answer):
    """The surface of one frame; points in the depth camera's frame: x right, y down, z away from the camera."""

    frame_index: int
    timestamp_us: int
    rows: int
    columns: int
    volume_l: float | None = Field(description="Difference from the reference; positive is a larger volume")
    vertices_mm: list[list[float]] = Field(description="[x, y, z], row by row from superior right")
    triangles: list[list[int]] = Field(
        description="Indices of three vertices, counter-clockwise as seen from the camera: normals "
        "point out of the patient"
    )


class GateView(Answer):
    """State of the gate of a running session."""

    state: Literal["disarmed", "hold", "dwell", "beam_on", "fault"]
    is_armed: bool
    hold_reason: str | None
    hold_text: str | None
    hold_detail: str = Field(default="", description="Details of the hold reason, with values")
    state_since: AwareDatetime | None = Field(
        default=None,
        description="When the gate changed to this state, or to its present reason, from the audit; null while that is"
        " not recorded",
    )
    operator_hold: str | None = Field(default=None, description="First operator who holds the beam by hand")
    operator_holds: list[str] = Field(
        default_factory=list, description="All operators who hold the beam by hand, in the order of their holds"
    )
    armed_by: str | None = Field(
        default=None, description="Who armed the gate, or released a hold since; null while it is disarmed"
    )
    armed_at: AwareDatetime | None = Field(
        default=None, description="When that was, from the audit; null while it is disarmed"
    )
    line_on: bool


class TrainingView(Answer):
    """Progress of the training; `share` runs from 0 to 1."""

    frames: int
    cycles: int
    seconds: float
    share: float
    note: str
    amplitude_mm: float | None = Field(default=None, description="Breathing amplitude so far")
    shift_mm: float | None = Field(default=None, description="Displacement of the region since the training started")


class LikenessView(Answer):
    """Result of comparing today's patient with the stored model that the session started with."""

    is_accepted: bool
    refusal: str | None = Field(
        description="Reason why the model does not match this patient; a new one is then trained"
    )
    frames: int
    explained_share: float = Field(description="Share of frames that the model explains, 0 to 1")
    residual_mm: float | None = Field(
        description="Median over the frames of the largest mean misfit of a cell; null if the model explains no frame"
    )
    shift_mm: list[float] = Field(
        description="Shift from the training to today: x right, y down, z away from the camera"
    )
    tilt_deg: float
    shape_mm: float = Field(description="Root mean square difference that remains after shift and tilt")


class CameraView(Answer):
    """The camera that a session opened, compared with the calibration's serial number."""

    name: str
    serial: str | None = Field(description="Serial number; null for a camera without one, or a recording without it")
    code: Literal["camera_mismatch", "serial_unknown"] | None = Field(
        description="`camera_mismatch`: the calibration belongs to another camera, refused in clinical mode; "
        "`serial_unknown`: the calibration has no serial number; null if both match, or if there is nothing to compare"
    )
    warning: Text | None = Field(description="Warning to display beside every result")


class BodyView(Answer):
    """Comparison of the surface that this session learned with that of the patient's newest earlier session."""

    session_id: Identifier = Field(description="The earlier session")
    model_id: Identifier
    shift_mm: list[float] = Field(
        description="Shift from the earlier session to today: x right, y down, z away from the camera"
    )
    tilt_deg: float
    shape_mm: float = Field(description="Root mean square difference that remains after shift and tilt")
    is_position_compared: bool = Field(
        description="False if the earlier session had another calibration: shift and tilt are then meaningless"
    )
    warning: Text | None = Field(description="Warning to display: a limit of the patient match is exceeded")


class LatencyView(Answer):
    """Latency from frame capture to the command at the beam line [ms]."""

    p50_ms: float | None
    p99_ms: float | None
    max_ms: float | None = None


class BeamOffSummary(Answer):
    """Times from a hold to the accelerator's beam off [ms], of each permit that ended with the beam on."""

    holds: int
    median_ms: float
    p95_ms: float
    slowest_ms: float


class HoldCount(Answer):
    """How often the gate began to hold for one reason."""

    reason: str
    text: str = Field(description="Sentence to display")
    count: int


class Summary(Answer):
    """Statistics of a session so far, from the database."""

    frames: int
    missed_frames: int = Field(description="Frames that the camera counted and the host never received")
    lost: int = Field(description="Frames that could not be measured")
    duty_cycle: float | None = Field(description="Share of frames with beam on while armed; null if never armed")
    beam_on_s: float | None = Field(
        default=None,
        description="Time that the beam line read on, or did not answer, from frame to frame; not a dose. null for"
        " sessions of versions that did not count it",
    )
    elapsed_s: float | None = Field(
        default=None, description="From the start to the end, or to now; null if not started"
    )
    holds: list[HoldCount] = Field(
        default=[],
        description="How often the gate began to hold, or to hold for another reason; the most frequent reason first",
    )
    transitions: int
    latency: LatencyView
    beam_off: BeamOffSummary | None = Field(
        default=None, description="null where the beam-on signal is no input, and until a hold was measured"
    )


class Session(Answer):
    """A session."""

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
        default="uploaded",
        description="`device registration` or `device calibration` (its maker's): this unit was not calibrated here",
    )
    calibration_warning: Text | None = Field(default=None, description="Warning to display beside every result")
    source_warning: Text | None = Field(
        default=None, description="Warning to display if a recording gates a real beam line"
    )
    window: Window = Field(description="As prescribed: at the creation of the session, or by `POST .../window` since")
    regions: Regions = Field(default=Regions())
    model_id: Identifier | None = Field(default=None, description="The stored model that the session started with")
    rt_plan_id: Identifier | None = Field(default=None, description="The RT Plan that the session was created from")
    head_direction: HeadSide | None = Field(default=None, description=f"{HEAD_WORDS}; null if unknown")
    continues: Identifier | None = Field(default=None, description="The session that this one continues")
    is_simulated_beam: bool
    created_at: AwareDatetime
    started_at: AwareDatetime | None
    ended_at: AwareDatetime | None
    signed_by: list[str] = Field(default=[], description="Who signed the report; in the list of sessions only")


class SessionDetail(Session):
    """A session with gate, training and statistics."""

    gate: GateView | None = Field(description="null unless running")
    alarms: list[LiveAlarm] = Field(
        default=[],
        description="Active alarms, the most urgent first; a latched one of a session that is over stays until it is"
        " acknowledged, or the next session runs",
    )
    measurement_state: Literal["training", "measuring", "lost"] | None
    training: TrainingView | None
    active_model_id: Identifier | None
    has_reference: bool | None = Field(default=None, description="Whether the reference is set; null unless running")
    reference: LiveReference | None = Field(
        default=None, description="The reference's distance from the fraction's first; null while none is set"
    )
    position_check: LivePositionCheck | None = Field(
        default=None, description="The patient's position against the plan's; null unless running"
    )
    checks: list[LiveCheck] = Field(
        default=[],
        description="What the gate rests on: each check of the measurement; empty without a reference",
    )
    reference_proposals: list[ReferenceProposalView] = Field(
        default=[], description="For `POST .../reference`; empty unless running, and until two breaths are known"
    )
    gate_window: LiveWindow | None = Field(
        default=None, description="As the gate applies it: in mm or l, with baseline corrections; null unless running"
    )
    predicted_duty_percent: float | None = Field(
        default=None,
        description="Share of the learned breaths inside `gate_window`; arming is refused above the site's "
        "`max_duty_percent`. null without a model and a reference, and for windows that need a breath hold",
    )
    breath: LiveBreath | None = Field(default=None, description="null while no frame is measured")
    breath_hold: LiveBreathHold | None = Field(default=None, description="null if the window has no breath hold")
    likeness: LikenessView | None = Field(
        default=None, description="null without a stored model, and until the comparison is complete"
    )
    camera: CameraView | None = Field(
        default=None, description="null unless running, and until the source has been opened"
    )
    body: BodyView | None = Field(
        default=None, description="null without an earlier session of the patient, and until a model was learned"
    )
    delivered_before_s: float | None = Field(
        default=None,
        description="Beam-on time of the sessions that this one continues, together; null if it continues none, or if"
        " one of them did not count it",
    )
    summary: Summary


class SessionPage(Answer):
    """Newest first; `next_cursor` is null on the last page."""

    items: list[Session]
    next_cursor: str | None


class Transition(Answer):
    """One change of the gate, from the audit log; fields ending in `_ns` are host monotonic time."""

    audit_sequence: int
    at: AwareDatetime
    frame_index: int | None
    from_state: str
    to_state: str
    reason: str | None
    operator: str | None
    detail: str
    captured_us: int | None
    captured_ns: int | None = Field(default=None, description="Time of capture, on the host's clock")
    received_ns: int | None
    decided_ns: int | None
    asserted_ns: int | None
    latency_ms: float | None = Field(
        default=None, description="From capture to the command at the beam line; null if the cause was not a frame"
    )
    number: int | None = Field(default=None, description="Number in the session's journal, ascending with gaps")
    armed_by: str | None = Field(
        default=None, description="Who had armed the gate, or released a hold since; null while it was disarmed"
    )
    recovered: bool = Field(
        default=False, description="Recovered from the journal at the next start, after the process was killed"
    )


class TransitionPage(Answer):
    """Transitions, oldest first; `next_cursor` is null on the last page."""

    items: list[Transition]
    next_cursor: str | None


class Device(Answer):
    """A connected camera."""

    uri: str
    name: str


class DeviceKind(Answer):
    """A kind of cameras, by its SDK."""

    label: str = Field(examples=["the RealSense SDK"])
    is_installed: bool
    install_hint: str = Field(description="What installs the SDK where it is missing")
    plug_in: str = Field(default="", description="Distribution and version, of a camera that is no part of Tidegate")


def device_kinds(kinds: Iterable[object]) -> list[DeviceKind]:
    """Return the engine's kinds of cameras as they are answered."""
    return [DeviceKind.model_validate(one, from_attributes=True) for one in kinds]


class DeviceList(Answer):
    """Cameras; `detail` says why the list is empty."""

    is_runtime_available: bool
    detail: str
    kinds: list[DeviceKind] = Field(default=[], description="Every kind of cameras that this version can use")
    items: list[Device]
