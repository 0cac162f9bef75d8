"""What the instruments of ``tidegate evaluate`` have in common: a recording measured while something looks on."""

import csv
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

from engine.calibration import Calibration
from engine.capture.oni_file import OniFileSource
from engine.clock import MonotonicClock
from engine.errors import InvalidValueError
from engine.evaluation.playing import play
from engine.frames import Measurement, RgbdFrame
from engine.oni.reader import describe
from engine.pipeline import PipelineSettings
from service.cli.measure_options import HEAD_DIRECTIONS
from service.cli.terminal import frame_bar


def watch(
    recording: Path,
    calibration: Calibration,
    settings: PipelineSettings,
    look_on: Callable[[RgbdFrame, Measurement], None],
) -> None:
    """Measure a recording with a progress bar; ``look_on`` sees every frame and what was made of it."""
    total = describe(recording).depth_frames
    with frame_bar() as progress:
        task = progress.add_task("training", total=total)
        for frame, measurement in play(OniFileSource(recording, clock=MonotonicClock()), calibration, settings):
            look_on(frame, measurement)
            if frame.index % 10 == 0:
                progress.update(task, completed=frame.index + 1, description=measurement.state.value)


def superior_of(head: str) -> tuple[float, float] | None:
    """Where the patient's head is in the picture."""
    if head not in HEAD_DIRECTIONS:
        raise InvalidValueError("head", head, f"one of {', '.join(HEAD_DIRECTIONS)}")
    return HEAD_DIRECTIONS[head]


def write_rows(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write a CSV file, whole or not at all."""
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(header)
            writer.writerows(rows)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def number(value: float | None, digits: int) -> str:
    """Write a number for a table or file; what could not be measured is empty, never zero."""
    return "" if value is None or not math.isfinite(value) else f"{value:.{digits}f}"
