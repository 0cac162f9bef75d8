"""Requests and answers of the latency of cameras."""

from typing import Annotated, Self

from pydantic import AwareDatetime, Field

from engine.capture import SourceDescription
from engine.qa.latency import OUTPUT_BOUNDS_MS, SECONDS_BOUNDS
from service.core.schemas.base import Answer, Identifier, Name, Request
from service.qa.schemas import Note, Verdict

Size = tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=1)]]
MODE = ("depth_size", "color_size", "fps")


class CameraMode(Answer):
    """A camera in one mode, as its driver describes it; sizes are width and height [px]."""

    name: str
    serial: str = Field(description="Empty for a camera without one")
    depth_size: Size
    color_size: Size
    fps: float

    @classmethod
    def of(cls, described: SourceDescription) -> Self:
        """Return what a source's description says of the camera."""
        return cls.model_validate({name: getattr(described, name) for name in cls.model_fields})

    @property
    def identity(self) -> str:
        """Serial number, or the name of a camera without one."""
        return self.serial or self.name

    @property
    def mode_text(self) -> str:
        """The mode in words."""
        return (
            f"depth {self.depth_size[0]} x {self.depth_size[1]}, colour {self.color_size[0]} x {self.color_size[1]}, "
            f"{self.fps:g} frames a second"
        )


class LatencyRunRequest(Request):
    """A measurement of a camera's latency, as `tidegate qa latency` stores it."""

    operator: Name
    camera: CameraMode
    seconds: float = Field(default=60.0, ge=SECONDS_BOUNDS[0], le=SECONDS_BOUNDS[1])
    output_delay_ms: float = Field(ge=OUTPUT_BOUNDS_MS[0], le=OUTPUT_BOUNDS_MS[1])
    is_beam_safe: bool = False
    seed: int = Field(ge=0)
    note: Note = ""


class CameraLatency(Answer):
    """The newest measured latency of a camera in one mode; all times from light to the receipt of the depth frame."""

    run_id: Identifier
    at: AwareDatetime
    operator: str
    camera: CameraMode
    median_ms: float
    p95_ms: float
    worst_ms: float
    uncertainty_ms: float
    counted_ms: float = Field(description="Median and uncertainty: what the gate counts for the camera, at least")
    verdict: Verdict
    refusal: str | None = Field(description="Why clinical mode refuses to arm with it, and what to do")


class CameraLatencyList(Answer):
    """The newest measured latency of each camera and mode."""

    configured_ms: float = Field(description="`TIDEGATE_CAMERA_LATENCY_MS`")
    max_age_days: float = Field(description="`qa.latency_max_age_days`")
    items: list[CameraLatency]
