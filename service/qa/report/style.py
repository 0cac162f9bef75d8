"""Colours and marks of a QA report; the marks are distinguishable in black and white."""

from dataclasses import dataclass
from typing import Literal

from service.qa.schemas import Verdict

INK, SOFT, LINE, PALE = "#14181c", "#56616b", "#c9d0d6", "#f1f4f6"
DASH = "\N{EN DASH}"
MEASURED, COMMANDED = "#0f5c8c", "#14181c"


@dataclass(frozen=True, slots=True, kw_only=True)
class Look:
    """A verdict's word, colour and mark; ``is_solid`` fills the badge, so that a failure is the darkest mark."""

    word: str
    color: str
    pale: str
    marker: Literal["circle", "triangle", "square"]
    is_solid: bool


LOOKS: dict[Verdict, Look] = {
    "pass": Look(word="PASS", color="#0b6b4f", pale="#ffffff", marker="circle", is_solid=False),
    "warn": Look(word="WARN", color="#9a5b00", pale="#fff0d0", marker="triangle", is_solid=False),
    "fail": Look(word="FAIL", color="#a3140c", pale="#a3140c", marker="square", is_solid=True),
}


def number(value: float | None, unit: str = "") -> str:
    """Format a number with its unit; an en dash for None."""
    if value is None:
        return DASH
    size = abs(value)
    digits = 0 if size >= 1000 else 1 if size >= 100 else 2 if size >= 1 or size == 0 else 3
    text = f"{value:.{digits}f}"
    text = text.rstrip("0").rstrip(".") if "." in text else text
    text = "0" if text in {"-0", ""} else text.replace("-", "\N{MINUS SIGN}")
    return f"{text} {unit}".strip()
