"""``tidegate measure``: a recording to motion in millimetres, in batch."""

from pathlib import Path
from typing import Annotated

import typer

from engine.calibration import load_calibration
from engine.capture.oni_file import OniFileSource
from engine.clock import MonotonicClock
from engine.errors import InvalidValueError, TidegateError
from engine.frames import Measurement
from engine.limits import GateLimits, GateWindow
from engine.offline import OfflineSummary, measure_recording
from engine.oni.reader import describe
from engine.pipeline import PipelineSettings
from engine.training import TrainingSettings
from service.cli.terminal import frame_bar, refused, say

HEAD_DIRECTIONS: dict[str, tuple[float, float] | None] = {
    "auto": None,
    "up": (0.0, -1.0),
    "down": (0.0, 1.0),
    "left": (-1.0, 0.0),
    "right": (1.0, 0.0),
}


def measure(
    recording: Annotated[Path, typer.Argument(help="An .oni recording.", metavar="REC.oni")],
    calibration: Annotated[Path, typer.Option(help="The cameras' calibration (tidegate.calibration/1).")],
    out: Annotated[Path, typer.Option(help="Folder for motion.csv, regions.npz and model.npz.")],
    point: Annotated[
        list[str] | None, typer.Option(help="ROW,COL of the 350 x 200 grid to report singly; repeatable.")
    ] = None,
    cell: Annotated[int, typer.Option(help="Side of a region's cell on the grid [px].")] = 25,
    components: Annotated[int, typer.Option(help="Principal components to keep.")] = 3,
    window: Annotated[
        str | None,
        typer.Option(help="SIGNAL:LOWER:UPPER in mm, e.g. whole:-1:3, to fill in what the gate would have decided."),
    ] = None,
    head: Annotated[
        str,
        typer.Option(
            help="Where the patient's head is in the picture: up, down, left or right; auto is up, or left where the "
            "markers' longer sides lie across."
        ),
    ] = "auto",
) -> None:
    """Measure a recording: every frame once, as fast as it can be read.

    Writes motion.csv (one row a depth frame), regions.npz and model.npz. Motion is in mm, positive towards the camera.
    """
    try:
        settings = PipelineSettings(
            cell_px=cell,
            points=tuple(_point(text) for text in point or []),
            superior_px=_superior(head),
            training=TrainingSettings(components=components),
        )
        limits = None if window is None else GateLimits(window=_window(window))
        summary = _measure(recording, calibration, out, settings, limits)
    except TidegateError as error:
        raise refused("measure", error) from error
    except OSError as error:
        raise refused("measure", f"{out} cannot be written ({error.strerror or error})") from error
    say(
        f"{summary.frames} frames: {summary.training_frames} taught the model ({summary.cycles} breathing cycles), "
        f"{summary.measured} measured, {summary.lost} lost by the measurement, {summary.missed_frames} missing in the "
        f"recording. Written to {out}"
    )
    if summary.shortcoming is not None:
        say(f"Mind: {summary.shortcoming}", "yellow")
    if summary.damage is not None:
        raise refused("measure", summary.damage)


def _measure(
    recording: Path,
    calibration: Path,
    out: Path,
    settings: PipelineSettings,
    limits: GateLimits | None,
) -> OfflineSummary:
    cameras = load_calibration(calibration)
    total = describe(recording).depth_frames
    with frame_bar() as progress:
        task = progress.add_task("training", total=total)

        def show(measurement: Measurement) -> None:
            if measurement.frame_index % 10 == 0:
                progress.update(task, completed=measurement.frame_index + 1, description=measurement.state.value)

        source = OniFileSource(recording, clock=MonotonicClock())
        summary = measure_recording(source, cameras, out, settings=settings, limits=limits, on_frame=show)
        progress.update(task, completed=summary.frames, description="done")
    return summary


def _point(text: str) -> tuple[int, int]:
    parts = text.split(",")
    try:
        row, column = (int(part) for part in parts)
    except ValueError as error:
        raise InvalidValueError("point", text, "ROW,COL, two whole numbers") from error
    return row, column


def _window(text: str) -> GateWindow:
    parts = text.split(":")
    try:
        signal, (lower, upper) = parts[0], (float(part) for part in parts[1:])
    except ValueError as error:
        raise InvalidValueError("window", text, "SIGNAL:LOWER:UPPER, a name and two numbers") from error
    return GateWindow(signal=signal, lower_mm=lower, upper_mm=upper)


def _superior(head: str) -> tuple[float, float] | None:
    if head not in HEAD_DIRECTIONS:
        raise InvalidValueError("head", head, f"one of {', '.join(HEAD_DIRECTIONS)}")
    return HEAD_DIRECTIONS[head]
