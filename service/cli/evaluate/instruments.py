"""Measurement of a recording with a callback per frame, for the instruments of ``tidegate evaluate``."""

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from engine.calibration.camera_calibration import Calibration
from engine.capture import OniFileSource, describe
from engine.core.clock import MonotonicClock
from engine.core.files import write_whole
from engine.core.frames import Measurement, RgbdFrame
from engine.lab.evaluation.playback import play
from engine.motion.settings import PipelineSettings
from service.cli.measure.options import head_direction
from service.cli.terminal import frame_bar


def watch(
    recording: Path,
    calibration: Calibration,
    settings: PipelineSettings,
    on_frame: Callable[[RgbdFrame, Measurement], None],
) -> None:
    """Measure a recording with a progress bar; call ``on_frame`` with every frame and its measurement."""
    total = describe(recording).depth_frames
    with frame_bar() as progress:
        task = progress.add_task("training", total=total)
        for frame, measurement in play(OniFileSource(recording, clock=MonotonicClock()), calibration, settings):
            on_frame(frame, measurement)
            if frame.index % 10 == 0:
                progress.update(task, completed=frame.index + 1, description=measurement.state.value)


def superior_of(head: str) -> tuple[float, float] | None:
    """Return the direction of the head in the picture; raise InvalidValueError."""
    side = head_direction(head)
    return None if side is None else side.superior_px


def write_rows(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file atomically."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(rows)
    write_whole(path, text.getvalue().encode())


def number(value: float | None, digits: int) -> str:
    """Format a number; a missing or non-finite value is an empty text, never zero."""
    return "" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
