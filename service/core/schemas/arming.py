"""Schemas of what a person looks at before arming: what would gate whom, and what is missing."""

from typing import Literal

from pydantic import Field

from service.core.schemas.base import Answer, Identifier
from service.core.schemas.live_messages import LiveWindow
from service.core.schemas.windows import Window

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


class ArmingItem(Answer):
    """One thing that has to be right before the gate is armed."""

    code: ArmingCode
    state: Literal["ok", "attention", "missing"] = Field(
        description="`missing`: arming is refused because of it; `attention`: a person has to look at it"
    )
    text: str = Field(description="What is in force, and what to do where something is missing")


class ArmingSummary(Answer):
    """What the gate would be armed with. Send its `state` with `POST .../arm`: the engine refuses any other."""

    session_id: Identifier
    is_ready: bool = Field(description="Nothing is missing, as far as is known without asking the engine to arm")
    items: list[ArmingItem]
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
