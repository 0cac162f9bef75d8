"""The role of everything that delivers frames."""

from dataclasses import dataclass
from typing import Protocol

from engine.frames import RgbdFrame


@dataclass(frozen=True, slots=True, kw_only=True)
class SourceDescription:
    """What a source is, for the audit and the page; ``serial`` is empty where a device tells none."""

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
    counts. It delivers every frame exactly once, in order, and says in ``missed_frames`` what the device lost.
    """

    def open(self) -> SourceDescription:
        """Acquire the device and start its streams; raise SourceLostError or RecordingError."""

    def read(self, timeout_s: float) -> RgbdFrame:
        """Return the next frame.

        Raises
        ------
        FrameTimeoutError
            Nothing came in time; the source is still usable. A SourceAwayError says that the camera is gone meanwhile.
        SourceEndedError
            A recording is over.
        SourceLostError
            The device is gone.
        RecordingError
            The recording is damaged from here on.
        """

    def close(self) -> None:
        """Release the device; safe to call twice, and after a failure."""
