"""What is asked of and told about the gate while a session runs: corrections of the baseline, and the interlocks."""

from typing import Self

from pydantic import Field, model_validator

from service.schema_base import Answer, Operator, Request, broken

UNITS = ("mm", "l")


class BaselineCorrectionRequest(Request):
    """A person confirms that the window follows the drift that they saw; in l for a window on the volume."""

    operator: Operator = ""
    by_mm: float | None = Field(
        default=None,
        ge=-50.0,
        le=50.0,
        examples=[1.5],
        description="How far the edges move, on top of earlier corrections; the sum is bounded by the site",
    )
    drift_mm: float | None = Field(
        default=None, ge=-200.0, le=200.0, examples=[1.5], description="The drift of the baseline that the person saw"
    )
    by_l: float | None = Field(default=None, ge=-5.0, le=5.0, description="For a window on the volume")
    drift_l: float | None = Field(default=None, ge=-20.0, le=20.0)

    @model_validator(mode="after")
    def _is_one_correction(self) -> Self:
        unit = next((unit for unit in UNITS if getattr(self, f"by_{unit}") is not None), "mm")
        other = "l" if unit == "mm" else "mm"
        for name in (f"by_{unit}", f"drift_{unit}"):
            if getattr(self, name) is None:
                raise broken(name, "missing", "given: how far to move the window, and the drift that was seen")
        for name in (f"by_{other}", f"drift_{other}"):
            if getattr(self, name) is not None:
                raise broken(name, getattr(self, name), f"left out: the correction is given in {unit}")
        return self

    @property
    def unit(self) -> str:
        """What it is told in."""
        return "mm" if self.by_mm is not None else "l"

    @property
    def by(self) -> float:
        """How far to move the edges, in its unit."""
        return float(getattr(self, f"by_{self.unit}"))

    @property
    def drift_seen(self) -> float:
        """The drift the person saw, in its unit."""
        return float(getattr(self, f"drift_{self.unit}"))


class InterlockSetting(Answer):
    """One of the site's settings that bounds an interlock."""

    name: str = Field(examples=["max_latency_ms"])
    variable: str = Field(description="In the environment", examples=["TIDEGATE_MAX_LATENCY_MS"])
    value: float | bool | list[str]
    low: float | None = Field(description="Lowest value that a site may set; null where it is no number")
    high: float | None = Field(description="Highest value that a site may set; null where it is no number")


class Interlock(Answer):
    """One reason to hold the beam."""

    code: str = Field(examples=["frame_stale"])
    text: str = Field(description="In the words of the treatment room")
    trips: str = Field(description="What trips it, for a physicist")
    latches: bool = Field(description="A fault: stays until a named person acknowledges it")
    settings: list[InterlockSetting]
    source: str = Field(description="The guideline it comes from; `own` where none asks for it")


class InterlockList(Answer):
    """Every reason there is."""

    items: list[Interlock]
