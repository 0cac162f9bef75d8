"""A recording as long as a run: a volunteer played forwards and backwards in turn, so that nothing jumps at a seam.

Backwards every picture has some noise of its own: a picture that came a moment before is a frozen camera's.
"""

from itertools import cycle
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from engine.capture.oni.codec import encode_16zt, encode_jpeg
from engine.capture.oni.reader import OniReader
from engine.capture.oni.streams import CodedFrame
from engine.capture.oni.writer import OniWriter
from engine.core.files import sync_file
from lab.phantom.recording import make_volunteer
from tests.support.build_cache import digest_of, made_once
from tests.support.phantom_recordings import MAKERS

BASE_S = 40.0
FPS = 30.0
JPEG_QUALITY = 90
COLOR_NOISE = 3
VOLUNTEER = {"scenario": "regular", "volunteer": 1, "seed": 1}


class _Picture(NamedTuple):
    """A picture as a file holds it."""

    is_depth: bool
    payload: bytes


def base_folder() -> Path:
    """Give the folder of the volunteer that everything is played from; made at the first call on this machine."""
    wish = (sorted(VOLUNTEER.items()), BASE_S, FPS, np.__version__, cv2.__version__)
    with made_once(f"load-{digest_of(wish, *MAKERS)}") as (kept, draft):
        if draft is not None:
            make_volunteer(
                "regular", volunteer=1, seed=1, seconds=BASE_S, fps=FPS, out=draft / "volunteer", workers=None
            )
    return kept / "volunteer"


def write_long(base: Path, seconds: float, out: Path) -> int:
    """Write a recording of at least so many seconds from the frames of another; returns its depth frames."""
    with OniReader(base) as reader:
        frames = list(reader.frames())
    depth_us = [frame.timestamp_us for frame in frames if frame.is_depth]
    # Half a frame's time before the first depth frame and after the last: at each seam they are a whole one apart.
    half_us = round(1e6 / FPS / 2)
    start_us, turn_us = depth_us[0] - half_us, depth_us[-1] - depth_us[0] + 2 * half_us
    random = np.random.default_rng(1)
    since_us = [frame.timestamp_us - start_us for frame in frames]
    forwards = [(at_us, _Picture(frame.is_depth, frame.payload)) for at_us, frame in zip(since_us, frames, strict=True)]
    others = [(turn_us - at_us, _as_another(frame, random)) for at_us, frame in zip(since_us, frames, strict=True)]
    backwards = others[::-1]
    written = 0
    with OniWriter(out, fps=FPS) as writer:
        for number, passage in enumerate(cycle((forwards, backwards))):
            if number * turn_us >= seconds * 1e6:
                break
            written += _write(writer, passage, number * turn_us)
    sync_file(out)  # else the disk is busy with it while the session runs, whose own writes wait
    return written


def _as_another(frame: CodedFrame, random: np.random.Generator) -> _Picture:
    """Return the picture with noise of its own: every second reading is a step off, as a still sensor's are."""
    if frame.is_depth:
        depth = frame.decode_depth().astype(np.int32)
        steps = random.choice(np.array([-1, 0, 0, 1]), depth.shape)
        return _Picture(is_depth=True, payload=encode_16zt(np.where(depth > 0, depth + steps, 0).astype(np.uint16)))
    color = frame.decode_color().astype(np.int32)
    noise = random.integers(-COLOR_NOISE, COLOR_NOISE + 1, color.shape)
    return _Picture(is_depth=False, payload=encode_jpeg((color + noise).clip(0, 255).astype(np.uint8), JPEG_QUALITY))


def _write(writer: OniWriter, passage: list[tuple[int, _Picture]], shift_us: int) -> int:
    depth = 0
    for timestamp_us, picture in passage:
        write = writer.write_depth_payload if picture.is_depth else writer.write_color_payload
        write(timestamp_us + shift_us, picture.payload)
        depth += picture.is_depth
    return depth


def volunteer_folder(recordings: Path, seconds: float) -> Path:
    """Make a folder of recordings with one volunteer of this length [s] and its calibration; return the volunteer's."""
    folder, base = recordings / "volunteer", base_folder()
    folder.mkdir(parents=True)
    write_long(base / "recording.oni", seconds, folder / "recording.oni")
    (folder / "calibration.json").write_bytes((base / "calibration.json").read_bytes())
    return folder
