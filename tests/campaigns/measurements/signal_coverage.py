"""How much of each signal the camera sees in honest recordings: what the limits of the coverage cost.

`python -m tests.campaigns.measurements.signal_coverage --volunteer 3` measures virtual volunteers and prints, over the
frames that the gate's other limits accept, the smallest share of whole and halves, the share of frames below the limits
for wide signals, cells and points, and the time that the shares of one frame take.
"""

import time
from collections.abc import Iterator
from typing import Annotated

import numpy as np
import typer

from engine.core.clock import NS_PER_US, ManualClock
from engine.core.frames import FloatArray, Motion, RgbdFrame
from engine.gating.limits import GateLimits
from engine.gating.windows import amplitude_window
from engine.motion.learning.seen_shares import prepare_seen_weights
from engine.motion.learning.trainer import InlineTrainer
from engine.motion.pipeline import Pipeline
from engine.motion.settings import PipelineSettings
from engine.verification.phantom.scene import Script
from engine.verification.phantom.studio import Studio
from engine.verification.phantom.truth import POINTS_RC

FPS = 10.0
SECONDS = {
    "regular": 32.0,
    "irregular": 32.0,
    "shift": 44.0,
    "dibh": 44.0,
    "occlusion": 40.0,
    "isovolume": 40.0,
    "events": 60.0,
}
TIMED = 500
VOLUNTEERS = (1, 3, 6)
SETTINGS = PipelineSettings(points=tuple((int(row), int(column)) for row, column in POINTS_RC))
LIMITS = GateLimits(window=amplitude_window(lower_mm=-1.0, upper_mm=1.0))


def motions(pipeline: Pipeline, studio: Studio, seconds: float) -> Iterator[Motion]:
    """Yield what was measured on the frames that the gate's other limits accept."""
    for index in range(int(seconds * FPS)):
        timestamp_us = round(index / FPS * 1e6)
        frame = RgbdFrame(
            index=index,
            device_index=index,
            timestamp_us=timestamp_us,
            color_timestamp_us=timestamp_us,
            received_ns=timestamp_us * NS_PER_US,
            depth_mm=studio.depth_frame(index, index / FPS),
            color=studio.color_frame(index, index / FPS),
        )
        motion = pipeline.measure(frame).motion
        if motion is not None and _is_accepted(motion):
            yield motion


def _is_accepted(motion: Motion) -> bool:
    fit = motion.projection
    return (
        fit.valid_share >= LIMITS.min_valid_share
        and fit.inlier_share >= LIMITS.min_inlier_share
        and fit.residual_mm <= LIMITS.max_residual_mm
    )


def shares_of(number: int, scenario: str, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Measure one recording: shares of the wide signals, of the cells that the model knows, and of the points."""
    seconds = SECONDS[scenario]
    studio = Studio(Script(scenario=scenario, volunteer=number, seconds=seconds, fps=FPS, seed=seed))
    pipeline = Pipeline(studio.scene.rig.calibration, SETTINGS, ManualClock(), InlineTrainer())
    found = list(motions(pipeline, studio, seconds))
    known = np.isfinite(found[-1].regions_mm)
    return (
        np.array([[one.seen.whole, one.seen.thorax, one.seen.abdomen] for one in found]),
        np.array([one.seen.cells[known] for one in found]),
        np.array([one.seen.points for one in found]),
    )


def microseconds_per_frame() -> float:
    """Time the shares of one frame [us]."""
    weights = prepare_seen_weights(SETTINGS.layout())
    seen = np.random.default_rng(1).random((88, 50)) < 0.9
    begun_ns = time.process_time_ns()
    for _ in range(TIMED):
        weights.by_region(weights.shares(seen))
    return (time.process_time_ns() - begun_ns) / TIMED / NS_PER_US


def main(
    volunteer: Annotated[list[int] | None, typer.Option(min=1, max=10)] = None,
    scenario: Annotated[list[str] | None, typer.Option()] = None,
    seed: int = 2017,
) -> None:
    """Measure honest recordings, and print what the limits of the coverage cost."""
    rows = []
    for number in volunteer or VOLUNTEERS:
        for name in scenario or SECONDS:
            wide, cells, points = shares_of(number, name, seed)
            rows.append((wide, cells, points))
            _report(f"volunteer {number}, {name}", wide, cells, points)
    _report("all", *(_together(parts) for parts in zip(*rows, strict=True)))
    typer.echo(f"shares of one frame: {microseconds_per_frame():.0f} us of processor time")


def _together(parts: tuple[FloatArray, ...]) -> FloatArray:
    """Join recordings whose models know different numbers of cells; unused columns are NaN."""
    most = max(part.shape[1] for part in parts)
    return np.concatenate([np.pad(part, ((0, 0), (0, most - part.shape[1])), constant_values=np.nan) for part in parts])


def _report(name: str, wide: FloatArray, cells: FloatArray, points: FloatArray) -> None:
    below = [
        100.0 * float((part < limit).sum() / np.isfinite(part).sum())
        for part, limit in (
            (wide, LIMITS.min_wide_share),
            (cells, LIMITS.min_signal_share),
            (points, LIMITS.min_signal_share),
        )
    ]
    typer.echo(
        f"{name}, {len(wide)} frames: whole and halves at least {wide.min():.3f}, below the limit {below[0]:.2f} %; "
        f"cells {below[1]:.2f} %, points {below[2]:.2f} %",
    )


if __name__ == "__main__":
    typer.run(main)
