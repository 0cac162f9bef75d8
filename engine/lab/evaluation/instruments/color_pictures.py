"""Colour pictures from files: a PNG or JPEG, or frames evenly spaced over an ``.oni`` recording."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from engine.calibration.laser_plane import LaserPlaneError
from engine.capture.oni.reader import OniReader
from engine.core.errors import RecordingError
from engine.core.frames import ColorImage
from engine.core.geometry import Intrinsics

FRAMES_PER_RECORDING = 20
MAX_BYTES = 64 * 1024 * 1024


def read_pictures(path: Path, camera: Intrinsics) -> Iterator[tuple[str, ColorImage]]:
    """Yield each picture of a file with a name, RGB.

    Raises
    ------
    LaserPlaneError
        The file is no picture, or its size differs from the calibrated camera's.
    RecordingError
        The recording cannot be read, or has no colour frames.
    """
    pictures = _of_recording(path) if path.suffix.lower() == ".oni" else _of_file(path)
    for name, picture in pictures:
        height, width = picture.shape[:2]
        if (width, height) != (camera.width, camera.height):
            bound = f"{camera.width}x{camera.height}, the size of the calibration's colour camera"
            raise LaserPlaneError(name, f"{width}x{height}", bound)
        yield name, picture


def _of_file(path: Path) -> Iterator[tuple[str, ColorImage]]:
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise LaserPlaneError("pictures", str(path), f"readable ({error.strerror})") from error
    if len(content) > MAX_BYTES:
        raise LaserPlaneError(path.name, f"{len(content)} bytes or more", f"at most {MAX_BYTES} bytes")
    is_known = content.startswith((b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"))
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR) if is_known else None
    if picture is None:
        raise LaserPlaneError(path.name, f"{len(content)} bytes", "a PNG or JPEG picture, or an .oni recording")
    yield path.name, np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _of_recording(path: Path) -> Iterator[tuple[str, ColorImage]]:
    with OniReader(path) as reader:
        count = sum(not frame.is_depth for frame in reader.frames())
        if count == 0:
            raise RecordingError(f"{path.name}: the recording has no colour frame")
        chosen = set(np.linspace(0, count - 1, min(FRAMES_PER_RECORDING, count)).astype(int).tolist())
        colors = (frame for frame in reader.frames() if not frame.is_depth)
        for index, frame in enumerate(colors):
            if index in chosen:
                yield f"{path.name} frame {index}", frame.decode_color()
