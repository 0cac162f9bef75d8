"""``tidegate evaluate plane`` and ``tidegate evaluate laser``: a laser line as the reference instrument."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

from engine.calibration import Calibration, LaserPlane, load_calibration, load_plane
from engine.calibration.procedures import Board
from engine.core.errors import InvalidValueError, TidegateError
from engine.motion import PipelineSettings, TrainingSettings
from lab.commands.evaluate.instruments import draw_laser, number, superior_of, watch, write_rows
from lab.evaluation.instruments.agreement import MIN_FRAMES, Agreement
from lab.evaluation.instruments.board import LitBoard, read_board, read_pictures
from lab.evaluation.instruments.laser import CELL_PX, LaserComparison, LaserGauge
from lab.evaluation.instruments.plane_calibration import PlaneCalibration, fit_plane
from service.cli.terminal import frame_bar, refused, say

LARGE_OFFSET_MM, GREATEST_OFFSET_MM = 10.0, 50.0
_COLUMNS = ("mean_mm", "deviation_mm", "largest_mm", "correlation")


def plane(
    pictures: Annotated[
        list[Path], typer.Argument(help="Colour pictures (PNG, JPEG, or .oni recordings) of the line on the board.")
    ],
    calibration: Annotated[Path, typer.Option(help="Calibration of the cameras (tidegate.calibration/1).")],
    columns: Annotated[int, typer.Option(help="Inner corners of the checkerboard along a row.")],
    rows: Annotated[int, typer.Option(help="Inner corners of the checkerboard along a column.")],
    square_mm: Annotated[float, typer.Option(help="Side of a square [mm].")],
    out: Annotated[Path, typer.Option(help="File for the plane (tidegate.laser-plane/1).")],
) -> None:
    """Determine the plane of a laser from pictures of its line on a checkerboard in at least two poses.

    Hold the board where the chest will be, nearer, farther and tilted, with the line across its squares; laser and
    camera must stay where they are from here until the last recording.
    """
    try:
        board, cameras = Board(columns=columns, rows=rows, square_mm=square_mm), load_calibration(calibration)
        found = fit_plane(_lit_boards(pictures, board, cameras), cameras)
        out.parent.mkdir(parents=True, exist_ok=True)
        found.plane.save(out)
    except TidegateError as error:
        raise refused("evaluate plane", error) from error
    except OSError as error:
        raise refused("evaluate plane", f"{out} cannot be written ({error.strerror or error})") from error
    _print_plane(found)
    say(f"Written to {out}")


def laser(
    recording: Annotated[Path, typer.Argument(help="An .oni recording with the laser's line.", metavar="REC.oni")],
    calibration: Annotated[Path, typer.Option(help="Calibration of the cameras (tidegate.calibration/1).")],
    plane: Annotated[Path, typer.Option(help="Plane of the laser, from `tidegate evaluate plane`.")],
    out: Annotated[Path, typer.Option(help="Folder for laser.csv and laser.png.")],
    point: Annotated[
        list[str] | None,
        typer.Option(
            help="ROW,COL of the 350 x 200 grid near the line; repeatable; five points along the line by default."
        ),
    ] = None,
    components: Annotated[int, typer.Option(help="Largest number of principal components of the motion model.")] = 6,
    head: Annotated[
        str, typer.Option(help="Direction of the head in the picture: auto, up, down, left or right.")
    ] = "auto",
) -> None:
    """Compare the measured motion with a laser line in the same recording (article, section 4.5.2).

    Writes laser.csv and laser.png, and prints the article's Table 2 for this recording: error in mm at each point.
    """
    try:
        cameras, lit = load_calibration(calibration), load_plane(plane)
        settings = PipelineSettings(
            cell_px=CELL_PX, superior_px=superior_of(head), training=TrainingSettings(components=components)
        )
        gauge = LaserGauge(cameras, lit, points=[_point(text) for text in point or []])
        watch(recording, cameras, settings, gauge.add)
        comparison = gauge.comparison()
        agreements = comparison.agreements()
        _refuse_unusable(comparison, agreements)
        out.mkdir(parents=True, exist_ok=True)
        _write(comparison, out / "laser.csv")
        draw_laser(comparison, out / "laser.png")
    except TidegateError as error:
        raise refused("evaluate laser", error) from error
    except OSError as error:
        raise refused("evaluate laser", f"{out} cannot be written ({error.strerror or error})") from error
    _print_agreements(comparison, agreements)
    _mind(lit, cameras, comparison, agreements)
    say(f"Written to {out}")


def _lit_boards(paths: list[Path], board: Board, cameras: Calibration) -> list[tuple[str, LitBoard]]:
    found: list[tuple[str, LitBoard]] = []
    looked = 0
    with frame_bar() as progress:
        task = progress.add_task("looking for the board", total=None)
        for path in paths:
            for name, picture in read_pictures(path, cameras.color):
                seen = read_board(picture, board, cameras.color)
                looked += 1
                progress.update(task, completed=looked)
                if isinstance(seen, str):
                    say(f"{name}: left out, {seen}", "yellow")
                else:
                    found.append((name, seen))
    return found


def _print_plane(found: PlaneCalibration) -> None:
    table = Table(title="Laser plane", title_justify="left", show_edge=False)
    table.add_column("picture")
    for name in ("points", "off the plane, rms in mm", "corners, rms in px"):
        table.add_column(name, justify="right")
    table.add_column("")
    for seen in found.pictures:
        note = "outlier, left out" if seen.is_outlier else ""
        table.add_row(seen.name, str(seen.points), f"{seen.rms_mm:.3f}", f"{seen.reprojection_px:.3f}", note)
    console = Console()
    console.print(table)
    x, y, z = found.plane.normal
    along, across = found.spread_mm
    console.print(
        f"\nnormal ({x:.5f}, {y:.5f}, {z:.5f}), {found.plane.distance_mm:.2f} mm from the colour camera; "
        f"rms {found.plane.rms_mm:.3f} mm over {found.plane.pictures} pictures; "
        f"points spread {along:.0f} mm along and {across:.0f} mm across",
        highlight=False,
        soft_wrap=True,
    )


def _refuse_unusable(comparison: LaserComparison, agreements: list[Agreement]) -> None:
    seen = max(one.frames for one in agreements)
    if seen < MIN_FRAMES:
        bound = f"{MIN_FRAMES} or more at one point: is the line red and across the region?"
        raise InvalidValueError("frames", f"{seen} in which the line was seen and motion measured", bound)
    if abs(comparison.offset_mm) > GREATEST_OFFSET_MM:
        bound = f"at most {GREATEST_OFFSET_MM:g} mm off what the depth camera sees: it is another laser's plane"
        raise InvalidValueError("plane", f"{comparison.offset_mm:.0f} mm off", bound)


def _write(comparison: LaserComparison, path: Path) -> None:
    names = []
    for row, column in comparison.points_rc:
        place = "none" if np.isnan(row) else f"{row:.0f}_{column:.0f}"
        names += [f"p{place}_laser_mm", f"p{place}_tidegate_mm"]
    both = np.stack([comparison.laser_mm, comparison.tidegate_mm], axis=-1).reshape(len(comparison.frame_index), -1)
    write_rows(
        path,
        ["frame_index", "timestamp_us", *names],
        (
            [index, time_us, *(number(value, 4) for value in values)]
            for index, time_us, values in zip(comparison.frame_index, comparison.timestamp_us, both, strict=True)
        ),
    )


def _print_agreements(comparison: LaserComparison, agreements: list[Agreement]) -> None:
    table = Table(title="Tidegate against the laser line, in mm", title_justify="left", show_edge=False)
    for name in ("point", "frames", "mean error", "deviation", "maximum", "correlation"):
        table.add_column(name, justify="left" if name == "point" else "right")
    for (row, column), one in zip(comparison.points_rc, agreements, strict=True):
        place = "not met" if np.isnan(row) else f"{row:.0f},{column:.0f}"
        table.add_row(place, str(one.frames), *_figures(one))
    whole = [one for one in agreements if one.mean_mm is not None]
    table.add_section()
    table.add_row(
        "mean",
        "",
        *(number(_mean([getattr(one, name) for one in whole]), 3) for name in _COLUMNS[:3]),
        number(_mean([one.correlation for one in whole]), 4),
    )
    console = Console()
    console.print(table)
    console.print(
        f"\ndepth of the skin, the laser's minus Tidegate's: {number(comparison.offset_mm, 2)} mm in the median",
        highlight=False,
        soft_wrap=True,
    )


def _figures(one: Agreement) -> list[str]:
    return [*(number(getattr(one, name), 3) for name in _COLUMNS[:3]), number(one.correlation, 4)]


def _mean(values: list[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _mind(lit: LaserPlane, cameras: Calibration, comparison: LaserComparison, agreements: list[Agreement]) -> None:
    if abs(comparison.offset_mm) > LARGE_OFFSET_MM:
        say(
            f"Note: the laser has the skin {comparison.offset_mm:.0f} mm deeper than Tidegate: is this the plane of "
            "this recording's laser, and does the calibration correct this sensor's depth?",
            "yellow",
        )
    if lit.calibration_sha256 != cameras.sha256:
        say(
            "Note: the plane was found with another calibration; the colour camera's has to be the same",
            "yellow",
        )
    for number_of, one in enumerate(agreements, start=1):
        if one.mean_mm is None:
            say(f"Note: point {number_of} was seen in {one.frames} frames, {MIN_FRAMES} are needed", "yellow")


def _point(text: str) -> tuple[int, int]:
    try:
        row, column = (int(part) for part in text.split(","))
    except ValueError as error:
        raise InvalidValueError("point", text, "ROW,COL, two whole numbers") from error
    return row, column
