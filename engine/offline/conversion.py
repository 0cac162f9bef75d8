"""One recording format to another: ``.oni``, ``.mcap``, a folder of PNG."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from engine.calibration import Calibration, parse_calibration
from engine.capture.mcap_file import COLOR, DEPTH, McapPictures, McapPictureWriter
from engine.capture.picture_folder import FolderPictures, FolderWriter
from engine.capture.pictures import (
    UNKNOWN,
    OniPictures,
    OniPictureWriter,
    PictureReader,
    PictureWriter,
    RecordingHead,
)
from engine.core.errors import InvalidValueError, RecordingError

KINDS = ".oni, .mcap, or a folder of PNG"


@dataclass(frozen=True, slots=True, kw_only=True)
class Conversion:
    """What was converted; ``damage`` says why the source ended early, None where it was whole."""

    depth: int
    color: int
    serial: str
    damage: str | None


def convert_recording(
    source: Path, target: Path, *, calibration: Path | None = None, on_progress: Callable[[int], None] = lambda _: None
) -> Conversion:
    """Convert a recording; JPEG pictures are handed on as they are, depths are equal.

    Parameters
    ----------
    calibration
        Calibration of the camera, kept in ``.mcap`` and folders; by default that of the source, where it has one.

    Raises
    ------
    RecordingError
        The source is no recording, or not one picture of it can be read; nothing is written then.
    InvalidValueError
        Source or target are of another form, or both are one.
    CalibrationError
        The calibration is none.
    """
    if source.resolve() == target.resolve():
        raise InvalidValueError("target", str(target), "another than the source")
    counts = {True: 0, False: 0}
    with _reader(source) as reader:
        head = reader.head
        if calibration is not None:
            head = replace(head, calibration=calibration.read_text(encoding="utf-8"))
        known = parse_calibration(head.calibration.encode()) if head.calibration else None
        if head.serial == UNKNOWN and known is not None and known.serial:
            head = replace(head, serial=known.serial)
        with _writer(target, head, known) as writer:
            for picture in reader.pictures():
                if picture.depth_mm is None and head.color_size is None:
                    raise RecordingError(f"{source.name}: its colour begins later than the first 30 depth pictures")
                try:
                    writer.write(picture)
                except ValueError as error:  # a picture of another size
                    raise RecordingError(f"{source.name}: {error}") from error
                counts[picture.depth_mm is not None] += 1
                on_progress(counts[True])
            if not counts[True]:
                raise RecordingError(reader.damage or f"{source.name}: has no depth picture")
        return Conversion(depth=counts[True], color=counts[False], serial=head.serial, damage=reader.damage)


def _reader(path: Path) -> PictureReader:
    if path.is_dir():
        return FolderPictures(path)
    readers: dict[str, Callable[[Path], PictureReader]] = {".oni": OniPictures, ".mcap": McapPictures}
    if path.suffix.lower() not in readers:
        raise InvalidValueError("source", path.name, KINDS)
    return readers[path.suffix.lower()](path)


def _writer(path: Path, head: RecordingHead, calibration: Calibration | None) -> PictureWriter:
    if path.suffix.lower() == ".oni":
        return OniPictureWriter(path, head)
    if path.suffix.lower() == ".mcap":
        return McapPictureWriter(path, head, None if calibration is None else _infos(calibration))
    if path.suffix:
        raise InvalidValueError("target", path.name, KINDS)
    return FolderWriter(path, head)


def _infos(calibration: Calibration) -> dict[str, tuple[tuple[float, ...], tuple[float, ...]]]:
    """Return matrix and distortion of both cameras, as a CameraInfo has them."""
    found = {}
    for topic, camera in ((DEPTH, calibration.depth), (COLOR, calibration.color)):
        matrix = tuple(float(one) for one in camera.matrix.ravel())
        found[topic] = (matrix, tuple(float(one) for one in camera.distortion))
    return found
