"""Messages of the coaching stream, ``tidegate.coach/1``: all that a patient screen gets to know.

No names, no ids and no lengths: levels are places on the displayed scale, 0 at its lower end and 1 at its upper.
"""

from typing import Annotated, Literal

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, TypeAdapter

SCHEMA: Literal["tidegate.coach/1"] = "tidegate.coach/1"
Instruction = Literal["breathe_in", "hold", "breathe_out", "breathe_freely", "none"]
Display = Literal["bar", "curve"]
Language = Literal["en", "de"]
LONGEST_COUNTDOWN_S = 120.0
"""Longest time limit of a breath hold (`engine.gating.windows.breath_hold`)."""
Place = Annotated[float, Field(ge=0.0, le=1.0)]


class CoachMessage(BaseModel):
    """Base of all messages of the coaching stream."""

    model_config = ConfigDict(frozen=True, extra="forbid", serialize_by_alias=True)


class CoachHello(CoachMessage):
    """First message of every connection."""

    type: Literal["hello"] = "hello"
    schema_name: Literal["tidegate.coach/1"] = Field(default=SCHEMA, alias="schema")


class CoachWait(CoachMessage):
    """Sent ten times a second while nothing is to be shown: no session, not armed, no reference, or a fault."""

    type: Literal["wait"] = "wait"
    sequence: int = Field(ge=1, description="Rises with every message; gaps are messages that were not sent")
    sent_at: AwareDatetime
    language: Language


class CoachBand(CoachMessage):
    """The comfort band on the displayed scale."""

    lower: Place
    upper: Place


class CoachGuide(CoachMessage):
    """The newest frame: what the screen draws."""

    type: Literal["guide"] = "guide"
    sequence: int = Field(ge=1, description="Rises with every message; gaps are messages that were not sent")
    sent_at: AwareDatetime
    age_ms: float = Field(ge=0.0, description="Time from receipt of the frame to `sent_at`: beyond 300, draw nothing")
    is_practice: bool = Field(description="Nothing is armed: the beam stays held, whatever the patient does")
    is_measured: bool = Field(description="The frame was measured; else there is no level and no instruction")
    level: Place | None = Field(description="Where the breath is on the displayed scale; null if not measured")
    band: CoachBand | None = Field(description="null if there is none that could be displayed")
    instruction: Instruction
    countdown_s: float | None = Field(
        ge=0.0, le=LONGEST_COUNTDOWN_S, description="Rest of a breath hold that has settled; null otherwise"
    )
    display: Display
    sounds: bool
    language: Language


AnyCoachMessage = Annotated[CoachHello | CoachWait | CoachGuide, Field(discriminator="type")]
COACH_MESSAGE: TypeAdapter[CoachHello | CoachWait | CoachGuide] = TypeAdapter(AnyCoachMessage)
