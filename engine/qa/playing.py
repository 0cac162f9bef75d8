"""A source's frames, for so long; it is closed whatever happens."""

from collections.abc import Iterator
from contextlib import contextmanager

from engine.capture.source import DepthSource, SourceDescription
from engine.errors import SourceEndedError
from engine.frames import RgbdFrame

READ_TIMEOUT_S = 5.0
US_PER_S = 1e6


@contextmanager
def opened(source: DepthSource) -> Iterator[SourceDescription]:
    """Open a source for a block, and close it."""
    try:
        yield source.open()
    finally:
        source.close()


def frames_of(source: DepthSource, seconds: float) -> Iterator[RgbdFrame]:
    """Deliver an open source's frames until it ends or ``seconds`` of device time have passed.

    Raises
    ------
    RecordingError, SourceLostError, FrameTimeoutError
        It cannot be read, or no longer.
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
