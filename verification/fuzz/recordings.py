"""Targets: recordings, and the pictures in them."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

from engine.capture.oni.codec import decode_16zt, decode_jpeg, encode_16zt, encode_jpeg
from engine.capture.oni.reader import OniReader, describe
from engine.capture.recording_source import OniFileSource
from engine.core.clock import ManualClock
from engine.core.errors import RecordingError, SourceEndedError
from tests.support.capture.oni_recordings import color_picture, depth_picture, write_recording
from verification.fuzz.target import Target, as_file

SMALL_PX = (16, 12)
SHAPE = (12, 16)


def read_recording(content: bytes) -> None:
    """Walk, describe and play: as `tidegate recordings` and a session do."""
    path = as_file(content, "fuzz.oni")
    describe(path, is_checked=True)
    source = OniFileSource(path, clock=ManualClock(), is_helped=False)
    try:
        source.open()
        while True:
            source.read(0.1)
    except SourceEndedError:
        pass
    finally:
        source.close()


def read_frames(content: bytes) -> None:
    """Walk the frames without decoding."""
    with OniReader(as_file(content, "frames.oni")) as reader:
        for _ in reader.frames(with_payload=False):
            pass


def recordings() -> Iterator[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        for depth, color in (("16zT", "JPEG"), ("NONE", "NONE")):
            path = Path(folder) / f"{depth}.oni"
            write_recording(path, frames=2, size_px=SMALL_PX, depth_codec=depth, color_codec=color)
            yield path.read_bytes()


def read_depth(content: bytes) -> None:
    decode_16zt(content, SHAPE)


def depths() -> Iterator[bytes]:
    yield encode_16zt(depth_picture(0, SMALL_PX))
    yield encode_16zt(depth_picture(0, SMALL_PX) // 8 * 8)


def read_color(content: bytes) -> None:
    decode_jpeg(content, SHAPE)


def colors() -> Iterator[bytes]:
    yield encode_jpeg(color_picture(0, SMALL_PX), 50)


TARGETS = (
    Target(
        name="oni",
        reads="`.oni` recordings: walked, described, every picture decoded, played "
        "(`engine.capture.oni`, `OniFileSource`)",
        read=read_recording,
        refusals=(RecordingError,),
        seeds=recordings,
        max_bytes=8192,
        words=("NIR\\x00", "16zT", "JPEG", "NONE", "xnMapOutputMode", "xnCropping", "xnPixelFormat", "S2D"),
    ),
    Target(
        name="depth_picture",
        reads="one `16zT` depth picture (`engine.capture.oni.codec`)",
        read=read_depth,
        refusals=(RecordingError,),
        seeds=depths,
        max_bytes=1024,
    ),
    Target(
        name="color_picture",
        reads="one JPEG colour picture (`engine.capture.oni.codec`)",
        read=read_color,
        refusals=(RecordingError,),
        seeds=colors,
        max_bytes=2048,
    ),
)
