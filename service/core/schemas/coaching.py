"""Coaching over HTTP: what a session's patient screen shows, and the screens that are paired.

Messages of the coaching stream, ``tidegate.coach/1``: all that a patient screen gets to know.

No names, no ids and no lengths: levels are places on the displayed scale, 0 at its lower end and 1 at its upper.
"""

from typing import Annotated, Literal, Self

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, StringConstraints, TypeAdapter, model_validator

from service.core.schemas.base import Answer, Identifier, Operator, Request, broken

SCHEMA: Literal["tidegate.coach/1"] = "tidegate.coach/1"
Instruction = Literal["breathe_in", "hold", "breathe_out", "breathe_freely", "none"]
Display = Literal["bar", "curve"]
Language = Literal["en", "de"]
LONGEST_COUNTDOWN_S = 120.0
"""Longest time limit of a breath hold (`engine.gating.windows.breath_hold`)."""
Place = Annotated[float, Field(ge=0.0, le=1.0)]
LOWEST_PERCENT, HIGHEST_PERCENT = -100.0, 300.0
"""As for the edges of a window in per cent."""
NARROWEST_PERCENT = 5.0
NARROWEST_SCALE_PERCENT = 20.0
LONGEST_REST_S = 120.0
Percent = Annotated[float, Field(ge=LOWEST_PERCENT, le=HIGHEST_PERCENT)]


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


class PercentRange(Request):
    """A part of the learned breathing range: 0 % is the end of exhale, 100 % the end of inhale."""

    lower_percent: Percent
    upper_percent: Percent

    def holds(self, other: "PercentRange") -> bool:
        """Whether another range lies inside this one."""
        return self.lower_percent <= other.lower_percent and other.upper_percent <= self.upper_percent


class Coaching(Request):
    """What the patient screen shows of a session; forgotten when the session ends."""

    display: Display = Field(default="bar", description="A bar, or the curve of the last seconds", examples=["curve"])
    band: PercentRange | None = Field(
        default=None,
        description="Comfort band, at least 5 % wide; of a breath hold inside the window. null: the window's edges",
    )
    scale: PercentRange | None = Field(
        default=None,
        description="What the screen's height shows, at least 20 % wide, with the band inside. null: breath and band",
    )
    rest_s: float = Field(
        default=10.0, ge=0.0, le=LONGEST_REST_S, description="Time of free breathing after a breath hold"
    )
    sounds: bool = Field(default=False, description="A soft tone with every new instruction")
    language: Language = Field(default="en", description="Language of the screen's words")
    is_practice: bool = Field(
        default=False, description="Guide the patient although nothing is armed; refused while armed, ended by arming"
    )

    @model_validator(mode="after")
    def _have_ranges(self) -> Self:
        for name, found, least in (
            ("band", self.band, NARROWEST_PERCENT),
            ("scale", self.scale, NARROWEST_SCALE_PERCENT),
        ):
            if found is not None and not found.upper_percent - found.lower_percent >= least:
                bound = f"at least {least:g} more than {name}.lower_percent"
                raise broken(f"{name}.upper_percent", found.upper_percent, bound)
        if self.band is not None and self.scale is not None and not self.scale.holds(self.band):
            value = f"{self.band.lower_percent:g} to {self.band.upper_percent:g} %"
            raise broken("band", value, f"inside scale: {self.scale.lower_percent:g} to {self.scale.upper_percent:g} %")
        return self


class CoachingRequest(Coaching):
    """All settings of a session's coaching; what is left out gets its default."""

    operator: Operator = ""

    @property
    def coaching(self) -> Coaching:
        """The settings without the operator."""
        return Coaching.model_construct(**{name: getattr(self, name) for name in Coaching.model_fields})


class CoachingView(Answer):
    """A session's coaching."""

    display: Display
    band: PercentRange | None
    scale: PercentRange | None
    rest_s: float
    sounds: bool
    language: Language
    is_practice: bool


class PairingCodeView(Answer):
    """A code for one screen; shown once, and not stored."""

    code: Annotated[str, StringConstraints(pattern=r"^\d{6}$")] = Field(description="To be entered at `/patient/`")
    expires_at: AwareDatetime
    expires_in_s: float = Field(description="From now on; it ends sooner after five wrong codes")


class PairRequest(Request):
    """The code that the console shows."""

    code: Annotated[str, StringConstraints(pattern=r"^\d{6}$")] = Field(examples=["123456"])


class WatcherView(Answer):
    """Who watches: a paired screen, or a person or program with the permission."""

    is_screen: bool
    expires_at: AwareDatetime | None = Field(description="When the pairing ends at the latest; null if no screen")


class ScreenView(Answer):
    """A paired screen."""

    id: Identifier
    number: int = Field(description="Counts the screens since the start of the service; the audit has it")
    paired_by: str
    address: str
    paired_at: AwareDatetime
    seen_at: AwareDatetime = Field(description="When it last watched")
    expires_at: AwareDatetime


class ScreenList(Answer):
    """The paired screens, the oldest first."""

    items: list[ScreenView]
    code_expires_at: AwareDatetime | None = Field(description="When the open code expires; null without one")
    next_cursor: Literal[None] = None
