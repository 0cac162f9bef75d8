"""Messages of the live stream, ``tidegate.live/1``; docs/4-integrate/stream.md shows one of each.

Unmeasured values are null, never zero. The messages are a separate contract with its own JSON Schema, so they do not
share classes with the REST schemas.
"""

from typing import Annotated, Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, TypeAdapter

from service.core.schemas.sentences import SENTENCES, SentenceParts, Text

CalibrationKind = Literal["uploaded", "device registration", "device calibration"]
SCHEMA: Literal["tidegate.live/1"] = "tidegate.live/1"
SessionStatusName = Literal["running", "ended", "stopped", "failed"]
StateName = Literal["training", "measuring", "lost"]
MoverName = Literal["couch", "camera", "camera_or_couch"]
GateName = Literal["disarmed", "hold", "dwell", "beam_on", "fault"]
Point = Annotated[list[float], Field(min_length=2, max_length=2)]
Cell = Annotated[list[int], Field(min_length=2, max_length=2)]
AlarmPriorityName = Literal["high", "medium", "low"]
SignalName = Literal["whole", "thorax", "abdomen", "region", "named", "point", "volume"]
HoldStageName = Literal["awaited", "settling", "held", "drifted", "over"]
CameraAdviceName = Literal["too_near", "too_far", "tilted", "gaps", "too_dark", "too_bright", "warming_up"]


class Message(BaseModel):
    """Base of all live messages."""

    model_config = ConfigDict(frozen=True, extra="forbid", serialize_by_alias=True, ser_json_inf_nan="null")


class Hello(Message):
    """First message of every connection; fields that do not apply are left out."""

    type: Literal["hello"] = "hello"
    schema_name: Literal["tidegate.live/1"] = Field(default=SCHEMA, alias="schema")
    version: str = Field(description="Version of the server")
    room: str | None = Field(default=None, description="The room's name, `TIDEGATE_ROOM`; left out without one")
    sent_at: AwareDatetime
    form: Literal["full", "thin"] = Field(description="Requested form of the samples")
    rate_hz: float | None = Field(default=None, description="Requested rate; left out for the camera's rate")
    camera_fps: float | None = Field(default=None, description="Frame rate of the running session's camera, if known")
    session_id: str | None = Field(default=None, description="Id of the running session")
    resumes_after: int | None = Field(
        default=None, description="Recorded samples after this frame follow, as requested"
    )
    ping_s: float = Field(description="A `ping` is sent when no other message was sent for this time")
    calibration: CalibrationKind | None = Field(
        default=None,
        description="Calibration of the running session; `device registration` or `device calibration` (its maker's):"
        " this unit was not calibrated here",
    )
    calibration_warning: str | None = Field(default=None, description="Warning to display beside every result")


class Idle(Message):
    """Sent twice a second while no session runs."""

    type: Literal["idle"] = "idle"
    sent_at: AwareDatetime


class Ping(Message):
    """Sent when no other message was sent for a second: the connection works, and there is no newer frame."""

    type: Literal["ping"] = "ping"
    sent_at: AwareDatetime


class Dropped(Message):
    """The client was too slow: samples before the next one were dropped."""

    type: Literal["dropped"] = "dropped"
    sent_at: AwareDatetime
    skipped: int = Field(ge=1, description="Number of samples dropped since the last one sent")
    gate_changes: int = Field(
        default=0, ge=0, description="How many of them were the first sample after a change of the gate"
    )


class Gap(Message):
    """After a reconnection: frames of the session that are not resent."""

    type: Literal["gap"] = "gap"
    sent_at: AwareDatetime
    session_id: str
    from_frame: int = Field(description="First missing frame")
    to_frame: int | None = Field(description="Last missing frame; null if unknown")
    reason: Literal["too_long_ago", "recorder_behind", "not_recorded", "busy"] = Field(
        description="`too_long_ago`: older than the site resends; `recorder_behind`: not recorded in time; "
        "`not_recorded`: no record of the session; `busy`: too many clients are reconnecting"
    )


class Resumed(Message):
    """After a reconnection: all following samples are live."""

    type: Literal["resumed"] = "resumed"
    sent_at: AwareDatetime
    session_id: str
    frames: int = Field(ge=0, description="Number of recorded samples that were sent")
    last_frame: int = Field(description="Index of the last one; the requested frame if none was sent")


class LiveAlarm(Message):
    """An active alarm of a session; priorities are those of IEC 60601-1-8."""

    number: int = Field(description="Number of this occurrence, for `POST .../acknowledge`")
    session_id: str
    code: str = Field(description="A hold reason, or `permit_without_beam`, `audit_trouble`, `thread_ended`")
    priority: AlarmPriorityName
    text: str = Field(description="Sentence for the operator")
    detail: Text = Field(description="Details with values, as at the beginning")
    sentences: list[SentenceParts] = SENTENCES
    since: AwareDatetime = Field(description="Beginning of the condition, before the alarm's delay")
    latches: bool = Field(description="It lasts until a named person acknowledges it, and ends with that")
    acknowledged_by: str | None = Field(description="The person who acknowledged it; null until then")
    acknowledged_at: AwareDatetime | None


class LiveAlarmEvent(Message):
    """A change of one alarm."""

    number: int = Field(description="Number of the event, rising by one; a gap means lost events")
    kind: Literal["begin", "acknowledged", "end"]
    at: AwareDatetime
    alarm: LiveAlarm = Field(description="As of this event")


class Alarms(Message):
    """The active alarms after an event; also sent after `hello` if there are any, without an event."""

    type: Literal["alarms"] = "alarms"
    sent_at: AwareDatetime
    event: LiveAlarmEvent | None
    active: list[LiveAlarm] = Field(description="All active alarms, the most urgent first; replaces any earlier list")


class LiveLost(Message):
    """Reason why this frame could not be measured; while `state` is `measuring`, why the gate does not rest on it."""

    reason: str
    detail: Text
    moved: MoverName | None = Field(
        default=None, description="What has moved since the reference: a new reference has to confirm it"
    )
    moved_mm: float | None = Field(default=None, description="By how much: largest change of depth at a marker")


class LiveTraining(Message):
    """Progress of the training; `share` runs from 0 to 1."""

    frames: int
    cycles: int
    seconds: float
    share: float
    note: Text
    amplitude_mm: float | None = Field(default=None, description="Breathing amplitude so far")
    shift_mm: float | None = Field(default=None, description="Displacement of the region since the training started")


class LiveCondition(Message):
    """One condition of the window as the gate applies it; fields that its kind does not have are null."""

    kind: Literal["amplitude", "breath_hold", "phase"]
    signal: SignalName
    row: int | None
    column: int | None
    name: str | None = Field(description="Name of the session's region, for signal `named`")
    label: str = Field(description="Display name of the signal")
    unit: Literal["mm", "l", "percent"] | None = Field(
        default=None,
        description="Unit of the edges, `still` and `max_drift`; percent until the breathing range is known",
    )
    lower: float | None = None
    upper: float | None = None
    hysteresis: float | None = None
    hold: Literal["inspiration", "expiration"] | None = None
    settle_ms: float | None = None
    still: float | None = Field(default=None, description="[mm], or [l] for signal `volume`")
    max_drift: float | None = Field(default=None, description="[mm], or [l] for signal `volume`")
    timeout_s: float | None = None
    from_percent: float | None = None
    to_percent: float | None = None
    min_confidence: float | None = None
    is_inside: bool = Field(description="Whether the newest frame meets the condition")
    seen_share: float | None = Field(
        default=None, description="Share of the signal's area that the camera sees in the newest frame, 0 to 1"
    )
    stage: HoldStageName | None = Field(default=None, description="Stage of a breath hold")


class LiveWindow(Message):
    """The gating window; the edges outside the list are those of the first condition, null if it has none in mm."""

    signal: SignalName
    row: int | None
    column: int | None
    lower_mm: float | None
    upper_mm: float | None
    hysteresis_mm: float | None
    join: Literal["and", "or"] = "and"
    conditions: list[LiveCondition] = Field(default=[], max_length=4)


class LiveLatency(Message):
    """Latency from frame capture to the command at the beam line [ms]."""

    last: float | None
    p50: float | None
    p99: float | None
    max: float | None = Field(default=None, description="Maximum of the session")
    warned: bool = Field(default=False, description="The last frame's latency was above the site's warning limit")


class LiveBreathEvent(Message):
    """An ongoing breathing event that is not quiet breathing."""

    kind: Literal["cough", "sigh", "apnoea", "talking", "irregular", "no_cycle", "drift"]
    confidence: float = Field(description="0 to 1")
    since_s: float
    detail: Text


class LiveBreath(Message):
    """Breathing of the first gated signal; unknown values are null."""

    signal: str = Field(description="Display name of the signal")
    unit: Literal["mm", "l"] = Field(description="Unit of amplitude, baseline and drift")
    phase_percent: float | None = Field(description="0 at the end of inhale, about 50 at the end of exhale")
    phase_confidence: float = Field(description="0 to 1")
    note: Text = Field(description="Reason why the phase is unknown; empty if it is known")
    rate_per_min: float | None
    rate_confidence: float
    amplitude: float | None
    baseline: float | None = Field(description="Mean end-exhale level of the last breaths")
    drift: float | None = Field(description="Difference of the baseline from its level during training")
    drift_per_s: float | None
    regularity: float | None = Field(description="Similarity of the breath to those before it, 0 to 1")
    events: list[LiveBreathEvent]


class LiveBreathHold(Message):
    """Progress of the window's breath hold."""

    hold: Literal["inspiration", "expiration"]
    stage: HoldStageName
    count: int = Field(description="Number of breath holds since arming")
    seconds: float | None = Field(description="Time in this stage; null while the hold is awaited")
    settle_s: float
    timeout_s: float


class LiveReference(Message):
    """How far the reference, and the window with its corrections, lie from the first reference of the fraction."""

    text: Text = Field(description="Sentence to display")
    distance_mm: float | None = Field(description="Compared with the budget; null if it is not known, see `unknown`")
    budget_mm: float = Field(description="Beyond it a reference or a correction needs a person's reason")
    is_beyond: bool = Field(description="Beyond the budget, or at an unknown distance")
    moved_mm: float | None = Field(description="Displacement of the surface, root mean square")
    shift_mm: float | None = Field(description="Rigid shift of the region's middle along the surface")
    height_mm: float | None = Field(description="Rigid shift towards the camera")
    turn_deg: float | None = Field(description="Rigid rotation in the surface's plane")
    tilt_deg: float | None = Field(description="Rigid rotation out of that plane")
    shape_mm: float | None = Field(description="What a rigid movement leaves, root mean square")
    uncertainty_mm: float | None = Field(
        description="Standard uncertainty of the reference: what it adds to every point's motion; null if not known"
    )
    level: float | None = Field(description="Level of the first gated signal, with the correction, in `unit`")
    correction: float = Field(description="Baseline correction of the window since the reference was set, in `unit`")
    unit: Literal["mm", "l"] = Field(description="Unit of `level` and `correction`")
    unknown: Text = Field(default="", description="Reason why the distance is not known")


class LiveDegree(Message):
    """One degree of freedom of the patient's position against the plan's."""

    name: Literal["lateral", "longitudinal", "vertical", "pitch", "roll", "yaw"]
    unit: Literal["mm", "deg"]
    value: float | None = Field(
        description="Positive: to the patient's left, to the head, towards the camera; right-handed about these axes."
        " null where it is not determined"
    )
    uncertainty: float | None = Field(description="Standard uncertainty; null where nothing can be compared")
    tolerance: float
    is_within: bool = Field(description="Determined, and within the tolerance")


class LivePositionCheck(Message):
    """The patient's position against that of the plan, and who signed it."""

    status: Literal["first_fraction", "no_reference", "unsigned", "lapsed", "signed"] = Field(
        description="`first_fraction`: nothing is to be signed, the confirmed reference becomes the plan's position;"
        " `lapsed`: the patient or the camera may have moved since the reference was set. Unless it is `first_fraction`"
        " or `signed`, arming is refused"
    )
    text: Text = Field(description="Sentence to display")
    plan_session_id: str | None = Field(description="The session whose first reference is the plan's position")
    reference_number: int | None = Field(description="For `POST .../position-check`; null while no reference is set")
    degrees: list[LiveDegree] = Field(description="Of the reference in use; empty where nothing is compared")
    shape_mm: float | None = Field(description="Distance of the surfaces that remains, root mean square")
    is_within: bool = Field(description="Compared, and all within the tolerance; else a signature needs a reason")
    shortcomings: list[Text] = Field(description="What is beyond the tolerance or not determined")
    signed_by: str | None
    reason: str = Field(description="Given with the signature; empty where none was needed")
    lapse: Text = Field(description="Why the position has to be taken again; empty where it has not")


class LivePosition(Message):
    """How far the patient has moved since the present reference, breathing aside; null where that is not known."""

    shift_mm: float | None = Field(description="Of the four markers, along the couch")
    turn_deg: float | None = Field(
        description="Of the markers: the larger of the rotations on the couch and about the body's axis"
    )
    travel_mm: float | None = Field(
        default=None,
        description="Of the markers along the couch, from end to end within ten seconds: on clothing they slide",
    )
    height_mm: float | None = Field(description="Of the surface, positive towards the camera")
    tilt_deg: float | None = Field(description="Of the surface, about the axis across the body")
    roll_deg: float | None = Field(description="Of the surface, about the body's long axis")


class LiveCheck(Message):
    """A check of the measurement against the reference: one that cannot work finds nothing."""

    name: Literal["surface", "color", "camera", "markers", "clock"]
    state: Literal["on", "off", "never"] = Field(
        description="`off`: it worked since the reference was set and cannot now; `never`: it has not worked since then"
    )
    seconds: float | None = Field(description="Time in this state, by the camera's clock; null where it is not kept")
    text: Text = Field(description="Sentence to display")


class LiveCameraView(Message):
    """How the camera looks at the patient: the middle of the picture, about once a second."""

    distance_mm: float | None = Field(description="Median depth; null without a reading")
    tilt_deg: float | None = Field(description="Of the surface's plane against the camera's axis")
    coverage: float = Field(description="Share of the pixels with a depth reading, 0 to 1")
    brightness: float = Field(description="Mean of the colour picture, 0 to 1")
    saturated: float = Field(description="Share of overexposed colour pixels, 0 to 1")
    running_s: float = Field(description="Time since the first frame of the session")
    warm_in_s: float = Field(
        description="How long the camera still has to run until the beam may be on; 0 where it is warm"
    )
    advice: list[CameraAdviceName] = Field(
        description="What lies outside of the recommended ranges; nothing is refused"
    )


class LiveLag(Message):
    """Delay of the first region's motion behind the second's; if it is unknown, `note` says why."""

    first: str
    second: str
    lag_s: float | None
    lag_deg: float | None
    period_s: float | None
    confidence: float | None
    note: Text


class Sample(Message):
    """The newest frame with its measurement and gate decision."""

    type: Literal["sample"] = "sample"
    form: Literal["full"] = "full"
    sequence: int = Field(description="Sequence number, the same for all clients: a gap means dropped samples")
    captured_at: AwareDatetime | None = Field(default=None, description="Time of capture, if the camera reports it")
    received_at: AwareDatetime | None = Field(default=None, description="Time of receipt by the host")
    sent_at: AwareDatetime = Field(description="Time at which the message was encoded")
    age_ms: float = Field(description="Time from receipt of the frame to `sent_at`")
    session_id: str
    session_status: SessionStatusName
    is_armed: bool
    is_simulated_beam: bool
    calibration: CalibrationKind = "uploaded"
    body_warning: Text | None = Field(
        default=None, description="Warning to display if the body differs from that of the patient's earlier session"
    )
    frame_index: int
    timestamp_us: int
    state: StateName
    lost: LiveLost | None
    training: LiveTraining | None
    gate: GateName
    hold_reason: str | None
    hold_text: str | None
    hold_detail: Text = Field(default="", description="Details of the hold reason, with values")
    sentences: list[SentenceParts] = SENTENCES
    operator_hold: str | None = Field(default=None, description="First operator who holds the beam by hand")
    operator_holds: list[str] = Field(
        default_factory=list, description="All operators who hold the beam by hand, in the order of their holds"
    )
    armed_by: str | None = Field(
        default=None, description="Who armed the gate, or released a hold since; null while it is disarmed"
    )
    line_on: bool
    accelerator_beam: Literal["on", "off", "unknown"] | None = Field(
        default=None, description="The accelerator's own beam-on signal; null where none is connected"
    )
    window: LiveWindow = Field(description="As the gate applies it: in mm or l, with baseline corrections")
    breath: LiveBreath | None = Field(default=None, description="null while no frame is measured")
    breath_hold: LiveBreathHold | None = Field(default=None, description="null if the window has no breath hold")
    reference: LiveReference | None = Field(default=None, description="null while no reference is set")
    position_check: LivePositionCheck | None = Field(default=None, description="null until a frame was decided on")
    position: LivePosition | None = Field(default=None, description="null while no frame is measured")
    checks: list[LiveCheck] = Field(
        default=[], description="What the gate rests on: each check of the measurement; empty without a reference"
    )
    camera_view: LiveCameraView | None = Field(default=None, description="For the set-up; null while the gate is armed")
    signal_mm: float | None
    whole_mm: float | None
    thorax_mm: float | None
    abdomen_mm: float | None
    volume_l: float | None
    residual_mm: float | None
    valid_share: float | None
    regions_mm: list[list[float | None]] | None = Field(
        description="Rows from superior, columns from the patient's right"
    )
    unseen_cells: list[Cell] | None = Field(
        default=None,
        description="Row and column of each cell of `regions_mm` that the camera does not see: its motion is "
        "extrapolated, and a gate on it holds. null while no frame is measured",
    )
    named_mm: dict[str, float | None] | None = Field(description="Motion of the session's regions, by name")
    split_rows: Point | None = Field(
        description="Rows at which the line between thorax and abdomen crosses the grid's right and left edges"
    )
    lags: list[LiveLag] | None = Field(
        description="Thorax relative to abdomen, then each named region relative to the whole"
    )
    roi_px: list[Point] | None = Field(
        description="Colour pixels: superior right, superior left, inferior left, inferior right"
    )
    fps: float | None
    frames: int
    missed_frames: int
    latency_ms: LiveLatency


class ThinSample(Message):
    """The newest frame, reduced to what monitors of the gate need; the fields are those of the full form."""

    type: Literal["sample"] = "sample"
    form: Literal["thin"] = "thin"
    sequence: int
    captured_at: AwareDatetime | None
    received_at: AwareDatetime | None
    sent_at: AwareDatetime
    age_ms: float
    session_id: str
    session_status: SessionStatusName
    is_armed: bool
    is_simulated_beam: bool
    frame_index: int
    timestamp_us: int
    state: StateName
    gate: GateName
    hold_reason: str | None
    hold_text: str | None
    line_on: bool
    signal_mm: float | None
    whole_mm: float | None
    thorax_mm: float | None
    abdomen_mm: float | None
    volume_l: float | None
    fps: float | None
    latency_ms: float | None = Field(description="Latency of this frame, from capture to the command at the beam line")


class RecordedSample(Message):
    """A recorded frame, resent after a reconnection."""

    type: Literal["sample"] = "sample"
    form: Literal["recorded"] = "recorded"
    captured_at: AwareDatetime | None
    received_at: AwareDatetime | None
    sent_at: AwareDatetime
    session_id: str
    frame_index: int
    timestamp_us: int
    state: StateName
    gate: GateName
    hold_reason: str | None
    hold_text: str | None
    line_on: bool
    signal_mm: float | None
    whole_mm: float | None
    thorax_mm: float | None
    abdomen_mm: float | None
    volume_l: float | None
    latency_ms: float | None


AnySample = Annotated[Sample | ThinSample | RecordedSample, Field(discriminator="form")]
LiveMessage = Annotated[Hello | Idle | Ping | Dropped | Gap | Resumed | Alarms | AnySample, Field(discriminator="type")]
LIVE_MESSAGE: TypeAdapter[
    Hello | Idle | Ping | Dropped | Gap | Resumed | Alarms | Sample | ThinSample | RecordedSample
] = TypeAdapter(LiveMessage)
