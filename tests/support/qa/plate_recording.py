"""A recording of the virtual plate, with its calibration beside it."""

from pathlib import Path

from engine.capture.oni.writer import OniWriter
from engine.core.errors import SourceEndedError
from lab.virtual_qa import FPS, VIRTUAL_CALIBRATION, virtual_plate


def record_virtual_plate(folder: Path, seconds: float = 11.0) -> Path:
    """Write plate.oni and calibration.json."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "plate.oni"
    source = virtual_plate(seconds=seconds).source
    description = source.open()
    with OniWriter(path, depth_size=description.depth_size, color_size=description.color_size, fps=FPS) as writer:
        while True:
            try:
                frame = source.read(1.0)
            except SourceEndedError:
                break
            writer.write_depth(frame.timestamp_us, frame.depth_mm)
            writer.write_color(frame.timestamp_us, frame.color)
    source.close()
    (folder / "calibration.json").write_text(VIRTUAL_CALIBRATION.to_json(), encoding="utf-8")
    return path
