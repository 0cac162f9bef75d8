"""What of an answer is written down where the whole answer is too much, or only lives once."""

from dataclasses import dataclass
from typing import Any

from engine import errors
from engine.frames import ColorImage, DepthImage, RgbdFrame
from engine.witness import Seam


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameHead:
    """A frame without its pictures, which lie in a recording."""

    index: int
    device_index: int
    missed_frames: int
    timestamp_us: int
    color_timestamp_us: int
    received_ns: int

    def with_pictures(self, depth_mm: DepthImage, color: ColorImage) -> RgbdFrame:
        """Return the frame as the engine had it."""
        return RgbdFrame(
            index=self.index,
            device_index=self.device_index,
            missed_frames=self.missed_frames,
            timestamp_us=self.timestamp_us,
            color_timestamp_us=self.color_timestamp_us,
            received_ns=self.received_ns,
            depth_mm=depth_mm,
            color=color,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Raised:
    """An error that was raised instead of an answer."""

    name: str
    text: str

    def again(self) -> Exception:
        """Return an error of the same kind that says the same; one of the engine's own where it was."""
        known: object = getattr(errors, self.name, None)
        kind = known if isinstance(known, type) and issubclass(known, errors.TidegateError) else None
        # Not made in its own way: what it was made of is not known.
        error: Exception = Exception.__new__(kind or type(self.name, (Exception,), {}))
        error.args = (self.text,)
        return error


def head_of(frame: RgbdFrame) -> FrameHead:
    """Return a frame's head."""
    return FrameHead(
        index=frame.index,
        device_index=frame.device_index,
        missed_frames=frame.missed_frames,
        timestamp_us=frame.timestamp_us,
        color_timestamp_us=frame.color_timestamp_us,
        received_ns=frame.received_ns,
    )


def kept_of(seam: Seam, value: Any) -> Any:  # noqa: ANN401 - whatever was answered there
    """Return what of an answer is written down."""
    if seam is Seam.FRAME:
        return head_of(value)
    if seam is Seam.TRAINED:
        return value is not None
    if seam is Seam.LETTERS:
        return [letter.command for letter in value]
    return value
