"""``tidegate calibrate plate``: a unit's depth correction from recordings of a flat plate at known distances."""

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from engine.core.files import write_whole
from service.cli.calibrate.convert import SerialOption, with_serial
from service.cli.terminal import NoBar, frame_bar, refused, say

if TYPE_CHECKING:
    from engine.calibration import Calibration, DepthSteps, Disparity
    from engine.calibration.procedures import DepthScale, PlateReading

NAME = "calibrate plate"
MUCH_DRIFT_MM = 0.5
GOOD_ERROR_MM = 1.0


def plate(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings of the plate, about 10 s each.", metavar="REC.oni...")
    ],
    *,
    distance_mm: Annotated[
        list[float],
        typer.Option(
            help="Distance from the front of the camera to the plate, one per recording, in their order [mm]."
        ),
    ],
    calibration: Annotated[Path, typer.Option(help="Calibration of the camera (tidegate.calibration/1).")],
    out: Annotated[
        Path, typer.Option(help="Calibration to write, with the depth correction; a report is written beside it.")
    ],
    part: Annotated[
        float, typer.Option(help="Central share of the picture's width and height that the plate fills, 0 to 1.")
    ] = 0.5,
    distance_error_mm: Annotated[float, typer.Option(help="Standard uncertainty of the given distances [mm].")] = 1.0,
    serial: SerialOption = None,
) -> None:
    """Determine the depth scale and offset of this camera and report the accuracy of depth at 850 mm."""
    from engine.calibration import load_calibration
    from engine.calibration.procedures import (
        check_distances,
        corrected,
        disparity_of,
        find_plate_steps,
        fit_depth_scale,
    )
    from engine.core.errors import TidegateError

    try:
        check_distances(distance_mm, len(recordings))
        cameras = load_calibration(calibration)
        steps = find_plate_steps(recordings)
        readings = _read(recordings, cameras, steps, part)
        scale = fit_depth_scale(
            readings, distance_mm, distance_error_mm=distance_error_mm, is_rounding_undone=steps is not None
        )
        disparity = disparity_of(cameras, steps)
        made = with_serial(corrected(cameras, scale, disparity), serial)
        report = {**scale.report(), "calibration_sha256": made.sha256}
        out.parent.mkdir(parents=True, exist_ok=True)
        write_whole(out.with_suffix(".report.json"), (json.dumps(report, indent=2, sort_keys=True) + "\n").encode())
        write_whole(out, made.to_json().encode())
    except TidegateError as error:
        raise refused(NAME, error) from error
    except OSError as error:
        raise refused(NAME, f"{out} cannot be written ({error.strerror or error})") from error
    _print_plates(scale)
    _say_how_good(scale, cameras, disparity, are_steps_known=steps is not None)
    say(f"{out} written, with {out.with_suffix('.report.json').name}")


def _read(
    recordings: list[Path], cameras: "Calibration", steps: "DepthSteps | None", part: float
) -> list["PlateReading"]:
    from engine.calibration.procedures import read_plate
    from engine.capture import describe

    readings = []
    with frame_bar() as progress:
        for path in recordings:
            task = progress.add_task(path.name, total=describe(path).depth_frames)
            show = partial(_show, progress, task)
            readings.append(read_plate(path, cameras, steps=steps, part=part, on_progress=show))
    return readings


def _show(progress: Progress | NoBar, task: TaskID, frames: int) -> None:
    progress.update(task, completed=frames)


def _print_plates(scale: "DepthScale") -> None:
    table = Table(title="plates, in mm", title_justify="left", show_edge=False)
    table.add_column("recording", no_wrap=True, overflow="ellipsis", min_width=14)
    for name in ("distance", "reading", "residual", "flatness", "noise", "drift", "tilt, deg"):
        table.add_column(name, justify="right")
    for reading, distance, residual in zip(scale.readings, scale.distances_mm, scale.residuals_mm, strict=True):
        values = (f"{distance:.1f}", f"{reading.reading_mm:.2f}", f"{residual:+.2f}", f"{reading.flatness_mm:.2f}")
        more = (f"{reading.noise_mm:.2f}", _drift_text(reading.drift_mm), f"{reading.tilt_deg:.1f}")
        table.add_row(reading.name, *values, *more)
    Console().print(table)


def _drift_text(drift_mm: float | None) -> str:
    """Format a drift [mm]; a recording of a second has none."""
    return "?" if drift_mm is None else f"{drift_mm:+.2f}"


def _say_how_good(
    scale: "DepthScale", before: "Calibration", disparity: "Disparity | None", *, are_steps_known: bool
) -> None:
    correction = scale.correction
    say(
        f"Depth = {correction.scale:.5f} x reading {correction.offset_mm:+.2f} mm, rms {scale.rms_mm:.2f} mm over the "
        "plates"
    )
    if scale.has_scale:
        say(f"At 850 mm: depth is accurate within {scale.error_mm:.2f} mm (good: {GOOD_ERROR_MM:g} mm or less)")
    else:
        where = float(scale.distances_mm.mean())
        say(
            "Note: one distance determines only the offset; scale 1 is assumed, and depth is accurate within "
            f"{scale.error_mm:.2f} mm at {where:.0f} mm only. Add a plate at least 100 mm nearer or farther",
            "yellow",
        )
    drifting = [reading.name for reading in scale.readings if abs(reading.drift_mm or 0.0) > MUCH_DRIFT_MM]
    if drifting:
        say(f"Note: the camera was still warming up in {', '.join(drifting)}: wait until the drift has ended", "yellow")
    if before.depth_correction is not None:
        say("The calibration had a depth correction before; the new one replaces it")
    if disparity is not None:
        say(f"The quantisation steps of the sensor are corrected: {disparity.step_px:.5f} px for a 75 mm baseline")
    elif not are_steps_known:
        say(
            "Note: too few quantisation steps to correct the sensor's rounding: tilt the plates by 2 to 5 deg", "yellow"
        )
