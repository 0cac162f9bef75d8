"""Read frames from a source for a limited time of the device's clock."""

from collections.abc import Iterator
from contextlib import contextmanager

from engine.capture.source import DepthSource, SourceDescription
from engine.core.errors import SourceEndedError
from engine.core.frames import RgbdFrame

READ_TIMEOUT_S = 5.0
US_PER_S = 1e6


@contextmanager
def opened(source: DepthSource) -> Iterator[SourceDescription]:
    """Open a source for the block, and close it on every way out."""
    try:
        yield source.open()
    finally:
        source.close()


def frames_of(source: DepthSource, seconds: float) -> Iterator[RgbdFrame]:
    """Yield an open source's frames until it ends or ``seconds`` of device time have passed.

    Raises
    ------
    RecordingError, SourceLostError, FrameTimeoutError
        Reading the source failed.
    """
    ends_us: float | None = None
    while True:
        try:
            frame = source.read(READ_TIMEOUT_S)
        except SourceEndedError:
            return
        ends_us = frame.timestamp_us + US_PER_S * seconds if ends_us is None else ends_us
        if frame.timestamp_us > ends_us:
            return
        yield frame
