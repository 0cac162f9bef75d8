"""The role of a frame source."""

from dataclasses import dataclass
from typing import Protocol

from engine.core.frames import RgbdFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceDescription:
    """Description of a source, for the audit and the page; ``serial`` is empty for a device without one."""

    kind: str
    name: str
    depth_size: tuple[int, int]
    color_size: tuple[int, int]
    fps: float
    is_live: bool
    serial: str = ""


class DepthSource(Protocol):
    """A camera, a recording or a simulator; owned by one thread.

    A source converts device units to millimetres and stamps frames with the engine's clock; no caller ever sees raw
    counts. It delivers every frame exactly once, in order; ``missed_frames`` counts what the device lost.
    """

    def open(self) -> SourceDescription:
        """Acquire the device and start its streams; raise SourceLostError or RecordingError."""

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame.

        Raises
        ------
        FrameTimeoutError
            No frame came in time; the source is still usable. A SourceAwayError means that the camera is disconnected.
        SourceEndedError
            The recording has ended.
        SourceLostError
            The device is disconnected.
        RecordingError
            The recording is damaged from here on.
        """

    def close(self) -> None:
        """Release the device; safe to call twice, and after a failure."""
