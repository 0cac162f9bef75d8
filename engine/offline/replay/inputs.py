"""The part of a reading that goes onto a tape, where the whole is too large or cannot be stored."""

from dataclasses import dataclass, replace
from typing import Any

from engine.core import errors
from engine.core.frames import ColorImage, DepthImage, RgbdFrame
from engine.core.input_tap import InputKind


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameHead:
    """A frame without its pictures, which are in a recording."""

    index: int
    device_index: int
    missed_frames: int
    timestamp_us: int
    color_timestamp_us: int
    received_ns: int
    queue_empty_ns: int | None = None

    def with_pictures(self, depth_mm: DepthImage, color: ColorImage) -> RgbdFrame:
        """Return the frame as the engine read it."""
        return RgbdFrame(
            index=self.index,
            device_index=self.device_index,
            missed_frames=self.missed_frames,
            timestamp_us=self.timestamp_us,
            color_timestamp_us=self.color_timestamp_us,
            received_ns=self.received_ns,
            queue_empty_ns=self.queue_empty_ns,
            depth_mm=depth_mm,
            color=color,
        )


@dataclass(frozen=True, slots=True, kw_only=True)
class Raised:
    """An error that was raised instead of a reading."""

    name: str
    text: str

    def again(self) -> Exception:
        """Return an error of the same class and text; a TidegateError where it was one."""
        known: object = getattr(errors, self.name, None)
        kind = known if isinstance(known, type) and issubclass(known, errors.TidegateError) else None
        # Made without its constructor: the arguments are not on the tape.
        error: Exception = Exception.__new__(kind or type(self.name, (Exception,), {}))
        error.args = (self.text,)
        return error


def raised_of(error: Exception) -> Raised:
    """Return an error as it is stored."""
    return Raised(name=type(error).__name__, text=str(error))


def head_of(frame: RgbdFrame) -> FrameHead:
    """Return a frame without its pictures."""
    return FrameHead(
        index=frame.index,
        device_index=frame.device_index,
        missed_frames=frame.missed_frames,
        timestamp_us=frame.timestamp_us,
        color_timestamp_us=frame.color_timestamp_us,
        received_ns=frame.received_ns,
        queue_empty_ns=frame.queue_empty_ns,
    )


def kept_of(kind: InputKind, value: Any) -> Any:  # noqa: ANN401 - any reading
    """Return the part of a reading that goes onto the tape."""
    match kind:
        case InputKind.FRAME if value.frame is not None:
            return replace(value, frame=head_of(value.frame))
        case InputKind.TURN:
            return replace(value, commands=tuple(queued.command for queued in value.commands))
        case InputKind.LINE if value.error is not None:
            return replace(value, error=raised_of(value.error))
        case InputKind.TRAINED:
            return value is not None
    return value
