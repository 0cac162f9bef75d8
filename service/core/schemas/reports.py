"""Schemas of a session's report: everything that it states, as numbers with their units."""

from typing import Annotated, Literal

from pydantic import AfterValidator, AwareDatetime, Field, SecretStr, StringConstraints

from service.core.schemas.base import Answer, Identifier, Operator, Request, printable_or_empty
from service.core.schemas.sessions import HoldCount, LatencyView, Session

SignatureMeaning = Literal["checked", "approved"]
ResidualSignal = Literal["whole", "thorax", "abdomen"]


class GatedMotion(Answer):
    """Motion while the beam was on, of one signal, around its own mean."""

    signal: str = Field(description="whole, thorax, abdomen, or the name of a named region")
    mean_mm: float
    deviation_mm: float = Field(description="Standard deviation")
    within_95_mm: float = Field(description="95 % of the samples lie no further from the mean")
    frames: int


class HeldTime(HoldCount):
    """A reason for which the armed gate held, with the time that it took."""

    seconds: float


class Range(Answer):
    """Median of a figure, and the range of its middle 90 %."""

    median: float
    low: float = Field(description="5th percentile")
    high: float = Field(description="95th percentile")


class Pulse(Answer):
    """One stretch of consecutive samples with the beam on; times since the first sample."""

    from_s: float
    to_s: float
    seconds: float
    spread: float | None = Field(description="Largest minus least of the gated signal in it [mm; l of a volume]")


class ReportFigures(Answer):
    """What is counted from the session's samples alone; times are from each sample to the next, at most a second."""

    frames: int
    missed_frames: int
    lost: int
    recorded_s: float
    armed_s: float
    beam_on_s: float
    duty_percent: float | None = Field(description="Beam on while armed; null if never armed")
    pulses: int = Field(description="Stretches of consecutive samples with the beam on")
    pulse_s: Range | None
    pulse_list: list[Pulse] = Field(default=[], description="Each of them")
    holds: list[HeldTime]
    motion: list[GatedMotion] = Field(description="Empty without beam on")
    cells: list[list[float | None]] = Field(
        description="For each cell of the region grid, from superior right: 95 % of the samples with beam on lie no"
        " further from the cell's mean [mm]; empty without beam on, null where a cell was hardly seen"
    )
    period_s: Range | None
    amplitude: Range | None = Field(description="mm; l where the gated signal is a volume")
    baseline_first: float | None = Field(description="Median of the first 30 s in which it is known")
    baseline_last: float | None = Field(description="Median of the last 30 s")
    latency: LatencyView
    latency_bins: list[int] = Field(
        description="Frames by latency, from 0 ms in steps of 5 ms; those of 200 ms and more are in the last"
    )


class SignalRange(Answer):
    """Least and most of a signal in each range of a trace; null where nothing was measured."""

    signal: ResidualSignal
    low_mm: list[float | None]
    high_mm: list[float | None]


class TraceHold(Answer):
    """A stretch in which the gate held for one reason; times since the session's first frame."""

    from_s: float
    to_s: float
    gate: str = Field(description="hold or fault")
    reason: str


class SessionTrace(Answer):
    """A part of the trace of a session that is over, at the scale that was asked for."""

    session_id: Identifier
    first_at: AwareDatetime | None = Field(description="Time of day of the first frame; null where it is not recorded")
    end_s: float = Field(description="Time of the last frame since the first")
    step_s: float = Field(description="Length of a range; 0 where each range is one sample")
    times_s: list[float] = Field(description="Of the first sample of each range, since the first frame")
    signals: list[SignalRange]
    beams_s: list[list[float]] = Field(description="Beginning and end of each stretch with the beam on")
    holds: list[TraceHold] = Field(description="Oldest first, without those for the breath outside its window")


class SessionMoment(Answer):
    """One sample of a session that is over, with the breathing surface."""

    session_id: Identifier
    at_s: float = Field(description="Time of the sample since the first frame")
    frame_index: int
    gate: str
    hold_reason: str | None
    lost_reason: str | None
    whole_mm: float | None
    thorax_mm: float | None
    abdomen_mm: float | None
    cells_mm: list[list[float | None]] = Field(description="By row from superior, and column from the patient's right")
    surface_mm: list[list[list[float] | None]] = Field(
        description="Nodes of the region's grid: the model's mean surface, its holes filled, moved by the cells"
        " around each; x right, y down, z away from the depth camera. Empty without a model or a measurement"
    )


class SignedDegree(Answer):
    """One of the six degrees of the position against the plan's, as it was signed."""

    name: str
    value: float | None
    unit: str
    tolerance: float


class ReportEvent(Answer):
    """What a person or the service did in the session, from the audit."""

    at: AwareDatetime
    actor: str
    action: str = Field(examples=["session.arm"])
    text: str = Field(description="What was done, with its reason")


class ReportSignature(Answer):
    """A note to a session that is over, or a signature under its report."""

    at: AwareDatetime
    name: str
    is_signed: bool = Field(description="false: a note only")
    meaning: SignatureMeaning | None = Field(default=None, description="Null of a note, and of earlier signatures")
    note: str
    content_sha256: str = Field(description="Of the content of the report that the person looked at")
    is_of_this: bool = Field(description="false: the report's content has changed since")


class ReportWindow(Answer):
    """A window of the session: as it was prescribed, and each one that was set or moved later."""

    at: AwareDatetime
    actor: str
    text: str = Field(description="Its conditions in words, or how it was moved")
    reason: str
    lower: float | None = Field(
        default=None, description="Of its first condition, in mm or l; null in per cent or phase"
    )
    upper: float | None = None


class _OfReport(Request):
    operator: Operator = ""
    content_sha256: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}$")] = Field(
        description="That of the report that was looked at; another one is refused"
    )


class NoteRequest(_OfReport):
    """A note under the report that was looked at; it signs nothing."""

    note: Annotated[str, StringConstraints(min_length=1, max_length=1000), AfterValidator(printable_or_empty)]


class SendRequest(_OfReport):
    """Send the report that was looked at, and the curve, to the PACS."""


class SentSession(Answer):
    """A session on its way to the PACS."""

    session_id: str
    state: Literal["waiting", "sent"]
    asked_by: str
    asked_at: str
    tries: int = Field(description="Attempts that failed")
    trouble: str = Field(description="Why the last attempt failed; empty without one")
    sent_at: str | None
    transaction: str = Field(description="UID of the storage commitment that was asked for; empty without one")
    committed_at: str | None = Field(description="When the PACS confirmed that it keeps the files")


class Sendings(Answer):
    """What was sent, and what waits."""

    is_configured: bool = Field(description="Whether the site names a PACS")
    items: list[SentSession]


class SignatureRequest(_OfReport):
    """A signature under the report that was looked at, and what it means."""

    meaning: SignatureMeaning = Field(description="checked: figures and deviations were looked at; approved: released")
    password: SecretStr | None = Field(
        default=None,
        min_length=1,
        max_length=1_000,
        description="The person's own; left out by people of an identity provider, who log in again just before",
    )
    note: Annotated[str, StringConstraints(max_length=1000), AfterValidator(printable_or_empty)] = ""


class ReportHead(Answer):
    """Place, equipment and persons of the session; the content hash covers the first three."""

    room: str
    machine: str
    armed_by: list[str] = Field(description="Who armed, in the order of their first time")
    plan_label: str = Field(description="Of the imported RT Plan; empty without one")
    plan_uid: str
    camera: str = Field(description="Name in the calibration, and the serial number where it has one")
    calibrated_at: AwareDatetime | None = Field(description="When the calibration was uploaded")
    qa: str = Field(description="Verdict of the newest daily QA in the 24 h before the start; empty without one")
    first_sample_at: AwareDatetime | None = Field(description="From which the times of figures and pulses count")


class SessionReport(Answer):
    """A session as its report states it."""

    session_id: Identifier
    head: ReportHead
    session: Session = Field(description="Names, operator and prescribed window as the audit has them")
    differs: list[str] = Field(
        description="Whose signature is of another content, and what the database states otherwise than the audit; "
        "empty where nothing differs"
    )
    windows: list[ReportWindow] = Field(description="The prescribed window, then each later one")
    figures: ReportFigures
    events: list[ReportEvent] = Field(description="Oldest first; the gate's own transitions only to a fault")
    deviations: list[str] = Field(description="What was not as planned or as usual; empty where nothing was")
    position: list[SignedDegree] = Field(description="As last signed; empty where none was")
    signatures: list[ReportSignature] = Field(description="Notes and signatures, oldest first")
    signatures_needed: int = Field(
        description="2 where the site asks for a second person, where a person went beyond a limit of the site with a "
        "reason, or overrode a plan; else 1. Of two one is by a person who did not arm"
    )
    model: str = Field(description="The newest model of the session; empty without one")
    software: str
    content_sha256: str = Field(description="Of all of the report but its notes and signatures: what is signed")
    samples_sha256: str = Field(description="Of the stored samples; empty while the session runs, or without any")
    calibration_sha256: str
    settings_sha256: str
