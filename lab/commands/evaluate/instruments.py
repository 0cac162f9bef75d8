"""Measurement of a recording with a callback per frame, for the instruments of ``tidegate evaluate``.

The pictures of ``tidegate evaluate laser`` and ``spirometer``, drawn by matplotlib without a display.
"""

import csv
import io
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from engine.calibration import Calibration
from engine.capture import OniFileSource, describe
from engine.core.clock import MonotonicClock
from engine.core.files import write_whole
from engine.core.frames import FloatArray, Measurement, RgbdFrame
from engine.motion import PipelineSettings
from lab.evaluation.instruments.laser import LaserComparison
from lab.evaluation.instruments.spirometer import SpirometerComparison, to_unit_range
from lab.evaluation.playback import play
from service.cli.measure.options import head_direction
from service.cli.terminal import frame_bar

if TYPE_CHECKING:
    from matplotlib.axes import Axes

OURS, THEIRS, ERROR = "#1f6fb2", "#c2410c", "#6b7280"
DPI = 110


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


def draw_laser(comparison: LaserComparison, path: Path) -> None:
    """Draw the article's Fig. 12: both motions of each point, and their difference beneath."""
    time_s = (comparison.timestamp_us - comparison.timestamp_us[0]) * 1e-6
    count = len(comparison.points_rc)

    def fill(axes: "list[Axes]") -> None:
        for point, ax in enumerate(axes):
            ours, laser = comparison.tidegate_mm[:, point], comparison.laser_mm[:, point]
            ax.plot(time_s, laser, ".", color=THEIRS, markersize=3, label="laser line")
            ax.plot(time_s, ours, color=OURS, linewidth=1.1, label="Tidegate")
            ax.plot(time_s, laser - ours, color=ERROR, linewidth=0.7, label="difference")
            ax.set_ylabel(f"{_place(comparison, point)}\n[mm]")
            _finish(ax, _span(time_s, np.isfinite(laser)))
        axes[0].set_title("Motion towards the camera beside the laser's line (ROW,COL of the ROI grid)", loc="left")
        axes[-1].set_xlabel("time since the first depth frame [s]")

    _draw(path, rows=count, height=1.9 * count + 0.8, fill=fill)


def draw_spirometer(time_s: FloatArray, comparison: SpirometerComparison, path: Path) -> None:
    """Draw the article's Fig. 11: both volumes in -1..1; and both in litres beneath."""

    def fill(axes: "list[Axes]") -> None:
        span = _span(time_s, np.isfinite(comparison.tidegate_l))
        pairs = (
            ("scaled to -1..1", to_unit_range(comparison.tidegate_l), to_unit_range(comparison.spirometer_l)),
            ("volume [l]", comparison.tidegate_l, comparison.spirometer_l),
        )
        for ax, (label, ours, theirs) in zip(axes, pairs, strict=True):
            ax.plot(time_s, theirs, ".", color=THEIRS, markersize=3, label="spirometer")
            ax.plot(time_s, ours, color=OURS, linewidth=1.1, label="Tidegate")
            ax.set_ylabel(label)
            _finish(ax, span)
        title = f"Volume: correlation {comparison.correlation:.4f}, lag {comparison.lag_s:.3f} s"
        axes[0].set_title(title, loc="left")
        axes[-1].set_xlabel("time since the first depth frame [s]")

    _draw(path, rows=2, height=5.6, fill=fill)


def _draw(path: Path, *, rows: int, height: float, fill: "Callable[[list[Axes]], None]") -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, height), layout="constrained")
    axes = [figure.add_subplot(rows, 1, row + 1) for row in range(rows)]
    fill(axes)
    # Above the curves, not over them.
    handles, labels = axes[0].get_legend_handles_labels()
    axes[0].legend(
        handles, labels, loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=len(labels), fontsize=8, frameon=False
    )
    write_whole(path, lambda file: figure.savefig(file, format="png", dpi=DPI))


def _finish(ax: "Axes", span: tuple[float, float]) -> None:
    ax.set_xlim(*span)
    ax.grid(visible=True, color="#e5e7eb", linewidth=0.6)
    for side in ("top", "right"):
        ax.spines[side].set_visible(False)


def _span(time_s: FloatArray, is_there: FloatArray) -> tuple[float, float]:
    """First and last time at which there is anything to see."""
    seen = time_s[is_there.astype(np.bool_)]
    return (float(seen[0]), float(seen[-1])) if len(seen) > 1 else (float(time_s[0]), float(time_s[-1]) + 1e-3)


def _place(comparison: LaserComparison, point: int) -> str:
    row, column = comparison.points_rc[point]
    return "not met" if np.isnan(row) else f"{row:.0f},{column:.0f}"
