"""``tidegate calibrate plate``: a unit's depth correction from recordings of a flat plate at known distances."""

import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.progress import Progress, TaskID
from rich.table import Table

from service.cli.terminal import NoBar, frame_bar, refused, say
from service.cli.written import write_whole

if TYPE_CHECKING:
    from engine.calibrating.depth_scale import DepthScale
    from engine.calibrating.plate import PlateReading
    from engine.calibration import Calibration, Disparity
    from engine.stages.quantisation import DepthSteps

NAME = "calibrate plate"
MUCH_DRIFT_MM = 0.5
GOOD_ERROR_MM = 1.0


def plate(
    recordings: Annotated[
        list[Path], typer.Argument(help="Recordings of the plate, some 10 s each.", metavar="REC.oni...")
    ],
    *,
    distance_mm: Annotated[
        list[float],
        typer.Option(help="Distance from the camera's front to the plate in mm, one a recording, in order."),
    ],
    calibration: Annotated[Path, typer.Option(help="The camera's calibration (tidegate.calibration/1).")],
    out: Annotated[Path, typer.Option(help="The calibration with the depth correction; a report goes beside it.")],
    part: Annotated[
        float, typer.Option(help="Share of the picture's width and height, in the middle, that the plate fills.")
    ] = 0.5,
    distance_error_mm: Annotated[
        float, typer.Option(help="Standard deviation of the distances as you measured them, in mm.")
    ] = 1.0,
) -> None:
    """Find this unit's depth scale and offset, and say what depth is worth at 850 mm."""
    from engine.calibrating.depth_scale import check_distances, corrected, disparity_of, fit_depth_scale
    from engine.calibrating.plate import find_plate_steps
    from engine.calibration import load_calibration
    from engine.errors import TidegateError

    try:
        check_distances(distance_mm, len(recordings))
        cameras = load_calibration(calibration)
        steps = find_plate_steps(recordings)
        readings = _read(recordings, cameras, steps, part)
        scale = fit_depth_scale(
            readings, distance_mm, distance_error_mm=distance_error_mm, is_rounding_undone=steps is not None
        )
        disparity = disparity_of(cameras, steps)
        made = corrected(cameras, scale, disparity)
        report = {**scale.report(), "calibration_sha256": made.sha256}
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
    from engine.calibrating.plate import read_plate
    from engine.oni.reader import describe

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
    for name in ("distance", "reading", "off", "flat to", "noise", "drift", "tilt deg"):
        table.add_column(name, justify="right")
    for reading, distance, residual in zip(scale.readings, scale.distances_mm, scale.residuals_mm, strict=True):
        values = (f"{distance:.1f}", f"{reading.reading_mm:.2f}", f"{residual:+.2f}", f"{reading.flatness_mm:.2f}")
        more = (f"{reading.noise_mm:.2f}", _told(reading.drift_mm), f"{reading.tilt_deg:.1f}")
        table.add_row(reading.name, *values, *more)
    Console().print(table)


def _told(drift_mm: float | None) -> str:
    """Write a drift, which a recording of a second does not tell."""
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
        say(f"At 850 mm: corrected depth is known to {scale.error_mm:.2f} mm (good: {GOOD_ERROR_MM:g} mm or less)")
    else:
        where = float(scale.distances_mm.mean())
        say(
            "Mind: one distance tells the offset alone; scale 1 is assumed, and depth known to "
            f"{scale.error_mm:.2f} mm at {where:.0f} mm only. Add a plate at least 100 mm nearer or farther",
            "yellow",
        )
    drifting = [reading.name for reading in scale.readings if abs(reading.drift_mm or 0.0) > MUCH_DRIFT_MM]
    if drifting:
        say(f"Mind: the camera was still warming up in {', '.join(drifting)}: wait until it drifts no more", "yellow")
    if before.depth_correction is not None:
        say("The calibration had a depth correction before; the new one replaces it")
    if disparity is not None:
        say(f"The sensor's steps were found, their rounding undone: {disparity.step_px:.5f} px for a 75 mm baseline")
    elif not are_steps_known:
        say("Mind: too few of the sensor's steps show to undo its rounding: tilt the plates by 2 to 5 deg", "yellow")
