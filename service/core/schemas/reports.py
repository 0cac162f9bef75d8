"""Schemas of a session's report: everything that it states, as numbers with their units."""

from typing import Literal

from pydantic import AwareDatetime, Field

from service.core.schemas.base import Answer, Identifier
from service.core.schemas.sessions import HoldCount, LatencyView, Session

ResidualSignal = Literal["whole", "thorax", "abdomen"]


class GatedMotion(Answer):
    """Motion while the beam was on, of one signal, around its own mean."""

    signal: ResidualSignal
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
    holds: list[HeldTime]
    motion: list[GatedMotion] = Field(description="Empty without beam on")
    period_s: Range | None
    amplitude: Range | None = Field(description="mm; l where the gated signal is a volume")
    baseline_first: float | None = Field(description="Median of the first 30 s in which it is known")
    baseline_last: float | None = Field(description="Median of the last 30 s")
    latency: LatencyView


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


class SessionReport(Answer):
    """A session as its report states it."""

    session_id: Identifier
    session: Session
    figures: ReportFigures
    events: list[ReportEvent] = Field(description="Oldest first; the gate's own transitions only to a fault")
    deviations: list[str] = Field(description="What was not as planned or as usual; empty where nothing was")
    position: list[SignedDegree] = Field(description="As last signed; empty where none was")
    model: str = Field(description="The newest model of the session; empty without one")
    software: str
    samples_sha256: str = Field(description="Of the stored samples; empty while the session runs, or without any")
    calibration_sha256: str
    settings_sha256: str
