"""A folder of PNG pictures as a recording: ``depth/`` of 16 bits in mm, ``color/``, and ``recording.json``."""

import json
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import cv2
import numpy as np
import numpy.typing as npt

from engine.capture.pictures import UNKNOWN, Picture, RecordingHead
from engine.core.errors import RecordingError
from engine.core.files import open_plain

HEAD_FILE, SCHEMA = "recording.json", "tidegate.pictures/1"
NAME = re.compile(r"(\d{1,9})_(\d{1,16})\.png")
LARGEST_BYTES, LARGEST_SIDE = 64 * 1024 * 1024, 4096
FOLDERS = {True: "depth", False: "color"}


class FolderWriter:
    """Writes pictures into a folder, which has another name until it is whole."""

    def __init__(self, path: Path, head: RecordingHead) -> None:
        self._path, self._head = Path(path), head
        if self._path.exists():
            raise RecordingError(f"{self._path.name}: exists already: give a folder that is not there")
        self._part = self._path.with_name(f".{self._path.name}.part")
        shutil.rmtree(self._part, ignore_errors=True)
        for name in FOLDERS.values() if head.color_size is not None else ("depth",):
            (self._part / name).mkdir(parents=True)

    def write(self, picture: Picture) -> None:
        """Append a picture."""
        is_depth = picture.depth_mm is not None
        width, height = self._head.color_size or (0, 0)
        shown = picture.depth_mm
        if shown is None:
            shown = np.asarray(cv2.cvtColor(picture.color((height, width)), cv2.COLOR_RGB2BGR))
        is_done, made = cv2.imencode(".png", shown, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        assert is_done, "a PNG can be made of any picture"
        name = f"{picture.frame_id:09d}_{picture.timestamp_us:016d}.png"
        (self._part / FOLDERS[is_depth] / name).write_bytes(made.tobytes())

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if kind is not None:
            shutil.rmtree(self._part, ignore_errors=True)
            return
        head = {
            "schema": SCHEMA,
            "serial": self._head.serial,
            "time_base": self._head.time_base,
            "mirrored": "no",
            "fps": self._head.fps,
            "calibration": json.loads(self._head.calibration) if self._head.calibration else None,
        }
        (self._part / HEAD_FILE).write_text(json.dumps(head, indent=1), encoding="utf-8")
        self._part.replace(self._path)


class FolderPictures:
    """A folder of pictures, in the order of their times.

    Raises
    ------
    RecordingError
        On opening: there is no depth picture, or a name or ``recording.json`` is of another form.
    """

    def __init__(self, path: Path) -> None:
        self._path = Path(path)
        self.damage: str | None = None
        self._files = sorted(
            (int(at), not is_depth, int(number), file)
            for is_depth, folder in FOLDERS.items()
            for file, number, at in self._named(folder)
        )
        stated = self._stated()
        depth_size, color_size = (self._size(is_depth=is_depth) for is_depth in (True, False))
        if depth_size is None:
            raise RecordingError(f"{self._path.name}: has no picture NUMBER_MICROSECONDS.png in depth/")
        calibration = stated.get("calibration")
        self.head = RecordingHead(
            depth_size=depth_size,
            color_size=color_size,
            fps=self._fps(stated.get("fps")),
            serial=str(stated.get("serial", UNKNOWN)),
            time_base=str(stated.get("time_base", UNKNOWN)),
            calibration=json.dumps(calibration) if isinstance(calibration, dict) else "",
        )

    def pictures(self) -> Iterator[Picture]:
        """Yield the pictures; the first one that cannot be read ends them."""
        try:
            for at_us, is_color, number, file in self._files:
                picture = self._read(file, is_depth=not is_color)
                if is_color:
                    rgb = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB), dtype=np.uint8)
                    yield Picture(timestamp_us=at_us, frame_id=number, rgb=rgb)
                else:
                    yield Picture(timestamp_us=at_us, frame_id=number, depth_mm=picture)
        except RecordingError as error:
            self.damage = str(error)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None

    def _named(self, folder: str) -> Iterator[tuple[Path, str, str]]:
        place = self._path / folder
        for entry in sorted(os.scandir(place), key=lambda one: one.name) if place.is_dir() else ():
            found = NAME.fullmatch(entry.name)
            if found is None:
                raise RecordingError(f"{self._path.name}: {folder}/{entry.name[:80]}: must be NUMBER_MICROSECONDS.png")
            yield Path(entry.path), found[1], found[2]

    def _stated(self) -> dict[str, object]:
        file = self._path / HEAD_FILE
        if not file.exists():
            return {}
        try:
            stated = json.loads(file.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise RecordingError(f"{self._path.name}: {HEAD_FILE} is no JSON ({error})") from error
        if not isinstance(stated, dict) or stated.get("schema") != SCHEMA:
            raise RecordingError(f"{self._path.name}: {HEAD_FILE}: schema must be {SCHEMA}")
        return stated

    def _fps(self, stated: object) -> float:
        if isinstance(stated, int | float) and 1.0 <= stated <= 1000.0:
            return float(stated)
        at_us = [at for at, is_color, _, _ in self._files if not is_color]
        steps = np.diff(at_us)
        return 30.0 if not len(steps) or np.median(steps) <= 0 else 1e6 / float(np.median(steps))

    def _size(self, *, is_depth: bool) -> tuple[int, int] | None:
        first = next((file for _, is_color, _, file in self._files if is_color is not is_depth), None)
        if first is None:
            return None
        height, width = self._read(first, is_depth=is_depth).shape[:2]
        return width, height

    def _read(self, file: Path, *, is_depth: bool) -> npt.NDArray[Any]:
        with open_plain(file) as opened:
            content = opened.read(LARGEST_BYTES + 1)
        flags = cv2.IMREAD_UNCHANGED if is_depth else cv2.IMREAD_COLOR
        found = cv2.imdecode(np.frombuffer(content, np.uint8), flags) if 0 < len(content) <= LARGEST_BYTES else None
        is_right = found is not None and max(found.shape[:2]) <= LARGEST_SIDE
        if found is None or not is_right or (is_depth and (found.dtype != np.uint16 or found.ndim != 2)):
            kind = "16 bits, one channel" if is_depth else "colour"
            raise RecordingError(f"{self._path.name}: {file.parent.name}/{file.name}: must be a PNG of {kind}")
        return found
