"""The messages of the live stream, ``tidegate.live/1``; docs/stream.md shows one of each.

What could not be measured is null, never zero. They stand apart from the REST schemas because they are a contract of
their own, with a JSON Schema of their own.
"""

from typing import Annotated, Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, TypeAdapter

CalibrationKind = Literal["uploaded", "device registration"]
SCHEMA: Literal["tidegate.live/1"] = "tidegate.live/1"
SessionStatusName = Literal["running", "ended", "stopped", "failed"]
StateName = Literal["training", "measuring", "lost"]
GateName = Literal["disarmed", "hold", "dwell", "beam_on", "fault"]
Point = Annotated[list[float], Field(min_length=2, max_length=2)]


class Message(BaseModel):
    """Base of all live messages."""

    model_config = ConfigDict(frozen=True, extra="forbid", serialize_by_alias=True, ser_json_inf_nan="null")


class Hello(Message):
    """First message of every connection; what does not apply is left out."""

    type: Literal["hello"] = "hello"
    schema_name: Literal["tidegate.live/1"] = Field(default=SCHEMA, alias="schema")
    version: str = Field(description="Of the server")
    sent_at: AwareDatetime
    form: Literal["full", "thin"] = Field(description="Of the samples that follow, as asked")
    encoding: Literal["json", "msgpack"] = Field(description="As asked; always `json` as server-sent events")
    rate_hz: float | None = Field(default=None, description="As asked; left out: the camera's rate")
    camera_fps: float | None = Field(default=None, description="Of the session that runs now, where it is known")
    session_id: str | None = Field(default=None, description="Of the session that runs now")
    resumes_after: int | None = Field(default=None, description="As asked: what was recorded after this frame follows")
    ping_s: float = Field(description="Never silent for much longer: a `ping` comes where nothing else does")
    calibration: CalibrationKind | None = Field(
        default=None, description="Of the session that runs now; `device registration`: nothing was measured"
    )
    calibration_warning: str | None = Field(default=None, description="To be shown beside every result")


class Idle(Message):
    """Twice a second while no session runs."""

    type: Literal["idle"] = "idle"
    sent_at: AwareDatetime


class Ping(Message):
    """Where nothing else was said for a second: the connection is there, and nothing is known that is newer."""

    type: Literal["ping"] = "ping"
    sent_at: AwareDatetime


class Dropped(Message):
    """The client took too long: samples were left out before the one that comes next."""

    type: Literal["dropped"] = "dropped"
    sent_at: AwareDatetime
    skipped: int = Field(ge=1, description="Samples left out since the last one")
    gate_changes: int = Field(default=0, ge=0, description="How many of them were the first after a change of the gate")


class Gap(Message):
    """After a break: frames of the session that are not sent again."""

    type: Literal["gap"] = "gap"
    sent_at: AwareDatetime
    session_id: str
    from_frame: int = Field(description="The first frame that is missing")
    to_frame: int | None = Field(description="The last one; null where that is not known")
    reason: Literal["too_long_ago", "recorder_behind", "not_recorded", "busy"] = Field(
        description="Further back than this site sends again; the recorder did not get there in time; there is no "
        "such record; too many others were coming back"
    )


class Resumed(Message):
    """After a break: from here on, what is sent is live."""

    type: Literal["resumed"] = "resumed"
    sent_at: AwareDatetime
    session_id: str
    frames: int = Field(ge=0, description="Samples sent from the record")
    last_frame: int = Field(description="The last of them; what was asked for where there was none")


class LiveLost(Message):
    """Why this frame could not be measured."""

    reason: str
    detail: str


class LiveTraining(Message):
    """How far the learning has come; share runs from 0 to 1."""

    frames: int
    cycles: int
    seconds: float
    share: float
    note: str
    amplitude_mm: float | None = Field(default=None, description="How deep the patient has breathed so far")
    shift_mm: float | None = Field(default=None, description="How far the region has moved since the gathering began")


SignalName = Literal["whole", "thorax", "abdomen", "region", "named", "point", "volume"]
HoldStageName = Literal["awaited", "settling", "held", "drifted", "over"]


class LiveCondition(Message):
    """One condition of the window, as the gate judges by it; what its kind does not have is null."""

    kind: Literal["amplitude", "breath_hold", "phase"]
    signal: SignalName
    row: int | None
    column: int | None
    name: str | None = Field(description="Of the session's own region, for signal `named`")
    label: str = Field(description="The signal, named for a person")
    unit: Literal["mm", "l", "percent"] | None = Field(
        default=None, description="Of edges, `still` and `max_drift`; per cent until the learned range is known"
    )
    lower: float | None = None
    upper: float | None = None
    hysteresis: float | None = None
    hold: Literal["inspiration", "expiration"] | None = None
    settle_ms: float | None = None
    still: float | None = Field(default=None, description="mm, l of the volume")
    max_drift: float | None = Field(default=None, description="mm, l of the volume")
    timeout_s: float | None = None
    from_percent: float | None = None
    to_percent: float | None = None
    min_confidence: float | None = None
    is_inside: bool = Field(description="Whether the newest frame meets it")
    stage: HoldStageName | None = Field(default=None, description="Of a breath hold")


class LiveWindow(Message):
    """The gating window; the edges beside the list are the first condition's, null where it has none in mm."""

    signal: SignalName
    row: int | None
    column: int | None
    lower_mm: float | None
    upper_mm: float | None
    hysteresis_mm: float | None
    join: Literal["and", "or"] = "and"
    conditions: list[LiveCondition] = Field(default=[], max_length=4)


class LiveLatency(Message):
    """From the camera taking the frame to the beam line told [ms]."""

    last: float | None
    p50: float | None
    p99: float | None
    max: float | None = Field(default=None, description="Of the whole session")
    warned: bool = Field(default=False, description="The last frame took longer than the site wants to be warned of")


class LiveBreathEvent(Message):
    """Something in the breathing that is no quiet breath, and is under way."""

    kind: Literal["cough", "sigh", "apnoea", "talking", "irregular", "drift"]
    confidence: float = Field(description="0 to 1")
    since_s: float
    detail: str


class LiveBreath(Message):
    """Where the first gated signal stands in the breath; what cannot be told is null."""

    signal: str = Field(description="The signal, named for a person")
    unit: Literal["mm", "l"] = Field(description="Of amplitude, baseline and drift")
    phase_percent: float | None = Field(description="0 at the end of inhale, about 50 at the end of exhale")
    phase_confidence: float = Field(description="0 to 1")
    note: str = Field(description="Why there is no phase; empty when there is one")
    rate_per_min: float | None
    rate_confidence: float
    amplitude: float | None
    baseline: float | None = Field(description="Level of the end of exhale, of the last breaths")
    drift: float | None = Field(description="How far the baseline is from where it was learned")
    drift_per_s: float | None
    regularity: float | None = Field(description="How much a breath is like those before it, 0 to 1")
    events: list[LiveBreathEvent]


class LiveBreathHold(Message):
    """Where the breath hold of the window stands."""

    hold: Literal["inspiration", "expiration"]
    stage: HoldStageName
    count: int = Field(description="Breath holds since the gate was armed")
    seconds: float | None = Field(description="Since this stage began; null while the hold is awaited")
    settle_s: float
    timeout_s: float


class LiveLag(Message):
    """How much later the first region moves than the second; a note says why it cannot be told."""

    first: str
    second: str
    lag_s: float | None
    lag_deg: float | None
    period_s: float | None
    confidence: float | None
    note: str


class Sample(Message):
    """The newest frame, as measured and decided."""

    type: Literal["sample"] = "sample"
    form: Literal["full"] = "full"
    sequence: int = Field(description="Counts what the server saw, for all clients alike: a gap is what was left out")
    captured_at: AwareDatetime | None = Field(default=None, description="The camera took the frame, where it tells")
    received_at: AwareDatetime | None = Field(default=None, description="The frame was in our hands")
    sent_at: AwareDatetime = Field(description="The message was made, once for all clients")
    age_ms: float = Field(description="Time from the frame in our hands to `sent_at`")
    session_id: str
    session_status: SessionStatusName
    is_armed: bool
    is_simulated_beam: bool
    calibration: CalibrationKind = "uploaded"
    frame_index: int
    timestamp_us: int
    state: StateName
    lost: LiveLost | None
    training: LiveTraining | None
    gate: GateName
    hold_reason: str | None
    hold_text: str | None
    hold_detail: str = Field(default="", description="More about why, with figures")
    operator_hold: str | None = Field(default=None, description="Who holds the beam by hand")
    line_on: bool
    window: LiveWindow = Field(description="As the gate judges by it: settled in mm or l, and corrected")
    breath: LiveBreath | None = Field(default=None, description="null while nothing is measured")
    breath_hold: LiveBreathHold | None = Field(default=None, description="null where the window has none")
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
    named_mm: dict[str, float | None] | None = Field(description="The session's own regions by their names")
    split_rows: Point | None = Field(
        description="Rows where the line between thorax and abdomen crosses the grid's right and left edge"
    )
    lags: list[LiveLag] | None = Field(description="Thorax against abdomen, then each named region against the whole")
    roi_px: list[Point] | None = Field(
        description="Colour pixels: superior right, superior left, inferior left, inferior right"
    )
    fps: float | None
    frames: int
    missed_frames: int
    latency_ms: LiveLatency


class ThinSample(Message):
    """The newest frame, as a monitor of the gate needs it; every field means what it means in the full form."""

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
    latency_ms: float | None = Field(description="Of this frame: from the camera taking it to the beam line told")


class RecordedSample(Message):
    """A frame from the record, after a break: what was measured and decided then."""

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
LiveMessage = Annotated[Hello | Idle | Ping | Dropped | Gap | Resumed | AnySample, Field(discriminator="type")]
LIVE_MESSAGE: TypeAdapter[Hello | Idle | Ping | Dropped | Gap | Resumed | Sample | ThinSample | RecordedSample] = (
    TypeAdapter(LiveMessage)
)
