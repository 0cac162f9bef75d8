"""Schemas of the gate: baseline corrections, interlocks, and what a person looks at before arming."""

from typing import Literal, Self

from pydantic import Field, model_validator

from service.core.schemas.base import Answer, Identifier, Operator, Request, broken
from service.core.schemas.live_messages import LiveWindow
from service.core.schemas.sentences import SENTENCES, SentenceParts, Text
from service.core.schemas.windows import Window

UNITS = ("mm", "l")
ArmingCode = Literal[
    "patient",
    "plan",
    "camera",
    "head_direction",
    "view",
    "model",
    "reference",
    "window",
    "position",
    "checks",
    "countersignature",
    "site",
    "gate",
]


class BaselineCorrectionRequest(Request):
    """A shift of the window by a baseline drift that a person confirms: in mm, or in l for signal volume."""

    operator: Operator = ""
    by_mm: float | None = Field(
        default=None,
        ge=-50.0,
        le=50.0,
        examples=[1.5],
        description="Shift of the window's edges, added to earlier corrections; the site bounds the sum",
    )
    drift_mm: float | None = Field(
        default=None,
        ge=-200.0,
        le=200.0,
        examples=[1.5],
        description="The baseline drift that the person saw; the call is refused if it has changed",
    )
    by_l: float | None = Field(default=None, ge=-5.0, le=5.0, description="As `by_mm`, for a window on the volume")
    drift_l: float | None = Field(default=None, ge=-20.0, le=20.0)
    reason: str = Field(
        default="",
        max_length=200,
        description="Required of a person where the window would lie beyond `max_reference_distance_mm` from the"
        " fraction's first reference; an API key cannot move it there",
    )

    @model_validator(mode="after")
    def _is_one_correction(self) -> Self:
        unit = next((unit for unit in UNITS if getattr(self, f"by_{unit}") is not None), "mm")
        other = "l" if unit == "mm" else "mm"
        for name in (f"by_{unit}", f"drift_{unit}"):
            if getattr(self, name) is None:
                raise broken(name, "missing", "given: send the shift of the window and the drift that was displayed")
        for name in (f"by_{other}", f"drift_{other}"):
            if getattr(self, name) is not None:
                raise broken(name, getattr(self, name), f"left out: the correction is given in {unit}")
        return self

    @property
    def unit(self) -> str:
        """Unit of the correction: "mm" or "l"."""
        return "mm" if self.by_mm is not None else "l"

    @property
    def by(self) -> float:
        """Shift of the edges, in `unit`."""
        return float(getattr(self, f"by_{self.unit}"))

    @property
    def drift_seen(self) -> float:
        """The drift that the person saw, in `unit`."""
        return float(getattr(self, f"drift_{self.unit}"))


class InterlockSetting(Answer):
    """A site setting that sets the limit of an interlock."""

    name: str = Field(examples=["max_latency_ms"])
    variable: str = Field(description="Name of the environment variable", examples=["TIDEGATE_MAX_LATENCY_MS"])
    value: float | bool | list[str] | None = Field(description="Null where the kind of the camera decides")
    low: float | None = Field(description="Lowest permitted value; null if the setting is not a number")
    high: float | None = Field(description="Highest permitted value; null if the setting is not a number")


class Interlock(Answer):
    """A check that holds the beam when it trips."""

    code: str = Field(examples=["frame_stale"])
    text: str = Field(description="Sentence for the operator")
    trips: str = Field(description="Condition that trips it, for the physicist")
    latches: bool = Field(description="True for a fault: the gate stays latched until a named person acknowledges it")
    settings: list[InterlockSetting]
    source: str = Field(description="The guideline that requires it; `own` if none does")


class InterlockList(Answer):
    """All interlocks."""

    items: list[Interlock]


class ArmingItem(Answer):
    """One thing that has to be right before the gate is armed."""

    code: ArmingCode
    state: Literal["ok", "attention", "missing"] = Field(
        description="`missing`: arming is refused because of it; `attention`: a person has to look at it"
    )
    text: Text = Field(description="What is in force, and what to do where something is missing")


class ArmingSummary(Answer):
    """What the gate would be armed with. Send its `state` with `POST .../arm`: the engine refuses any other."""

    session_id: Identifier
    is_ready: bool = Field(description="Nothing is missing, as far as is known without asking the engine to arm")
    items: list[ArmingItem]
    sentences: list[SentenceParts] = SENTENCES
    window: Window = Field(description="As prescribed")
    gate_window: LiveWindow | None = Field(description="As the gate applies it; null until a frame was decided on")
    predicted_duty_percent: float | None
    needs_reason: bool = Field(
        description="A person has to arm, with a reason: the window joins conditions by `or`, or reaches beyond the"
        " fraction's first armed one by more than the budget of references"
    )
    state: str = Field(
        description="Hash of window, its correction and times, reference, model and head direction; empty while the"
        " session does not run"
    )
