"""``tidegate calibrate checkerboard``: both cameras and their pose from pictures of a checkerboard."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from rich.table import Table

from engine.core.files import write_whole
from service.cli.calibrate.convert import SerialOption, with_serial
from service.cli.terminal import frame_bar, refused, say

if TYPE_CHECKING:  # OpenCV takes its time to import, and `--help` does not need it
    from engine.calibration.procedures import Board, CheckerboardResult, FoundBoards

NAME = "calibrate checkerboard"
GOOD_PAIRS = 15
GOOD_COVERAGE = 0.6
GOOD_RESIDUAL_MM, GOOD_ALIGNMENT_MM, GOOD_SCALE_MM = 0.5, 0.3, 0.2


def checkerboard(
    *,
    depth_pictures: Annotated[
        str,
        typer.Option(
            help="Folder or 'pattern' of the pictures of the infrared (depth) camera, taken with the projector covered."
        ),
    ],
    color_pictures: Annotated[
        str, typer.Option(help="Folder or 'pattern' of the pictures of the colour camera, of the same board poses.")
    ],
    columns: Annotated[int, typer.Option(help="Inner corners along one side: number of squares minus one.")],
    rows: Annotated[int, typer.Option(help="Inner corners along the other side; must differ from --columns.")],
    square_mm: Annotated[float, typer.Option(help="Side of a square, measured over many squares [mm].")],
    out: Annotated[
        Path,
        typer.Option(help="Calibration file to write; a report and a plot of the residuals are written beside it."),
    ],
    camera: Annotated[str, typer.Option(help="Name of the camera.")] = "camera",
    infrared_offset: Annotated[
        str, typer.Option(help="X,Y: shift of the device's depth picture relative to the infrared picture [px].")
    ] = "0,0",
    serial: SerialOption = None,
) -> None:
    """Calibrate both cameras and the pose between them, without outliers, and report the accuracy at 850 mm.

    Pictures of one board pose are matched by name, or by order if no names are equal.
    """
    from engine.calibration.procedures import Board, calibrate, list_pictures, match_pictures
    from engine.core.errors import InvalidValueError, TidegateError
    from service.cli.calibrate.residuals import draw_residuals

    try:
        board = Board(columns=columns, rows=rows, square_mm=square_mm)
        offset = _offset(infrared_offset)
        if not 1 <= len(camera) <= 80 or not camera.isprintable():
            raise InvalidValueError("camera", camera, "1 to 80 printable characters")
        pictures = [
            list_pictures(f"{kind}-pictures", where)
            for kind, where in (("depth", depth_pictures), ("color", color_pictures))
        ]
        matched, unpaired = match_pictures(*pictures)
        found = _find(board, matched)
        result = calibrate(board, found, camera=camera, infrared_offset_px=offset, unpaired=unpaired)
        report = json.dumps(result.report(), indent=2, sort_keys=True) + "\n"
        out.parent.mkdir(parents=True, exist_ok=True)
        write_whole(out.with_suffix(".residuals.png"), draw_residuals(result))
        write_whole(out.with_suffix(".report.json"), report.encode())
        write_whole(out, with_serial(result.calibration, serial).to_json().encode())
    except TidegateError as error:
        raise refused(NAME, error) from error
    except OSError as error:
        raise refused(NAME, f"{out} cannot be written ({error.strerror or error})") from error
    _print_pictures(result)
    _print_accuracy(result)
    say(f"{out} written, with {out.with_suffix('.report.json').name} and {out.with_suffix('.residuals.png').name}")


def _find(board: "Board", matched: list[tuple[Path, Path]]) -> "FoundBoards":
    from engine.calibration.procedures import find_boards
    from engine.core.errors import CalibrationError

    with frame_bar() as progress:
        task = progress.add_task("detecting the board", total=len(matched))
        found = find_boards(board, matched, lambda done, _total: progress.update(task, completed=done))
    if not found.pairs:
        bound = (
            f"a board of {board.columns} x {board.rows} inner corners, with a white margin, completely in the picture"
        )
        raise CalibrationError("pictures", f"{len(matched)} pairs, no board in any", bound)
    return found


def _offset(text: str) -> tuple[float, float]:
    from engine.core.errors import InvalidValueError

    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InvalidValueError("infrared-offset", text, "X,Y, two numbers") from error
    return x, y


def _print_pictures(result: "CheckerboardResult") -> None:
    table = Table(title="RMS error of the corners per picture, in px", title_justify="left", show_edge=False)
    for name in ("picture", "infrared", "colour", "colour against depth"):
        table.add_column(name, justify="left" if name == "picture" else "right")
    errors = result.fit.errors_px
    for i, pair in enumerate(result.fit.pairs):
        table.add_row(pair.name, *(f"{errors[kind][i]:.3f}" for kind in ("depth", "color", "alignment")))
    Console().print(table)
    for name, reason in result.fit.outliers.items():
        say(f"Outlier, not used: {name}: {reason}", "yellow")
    for name, reason in result.unseen.items():
        say(f"Not used: {name}: {reason}", "yellow")
    for name in result.unpaired:
        say(f"Not used: {name}: the other camera has no picture of that name", "yellow")


def _print_accuracy(result: "CheckerboardResult") -> None:
    used, accuracy = len(result.fit.pairs), result.accuracy
    if used < GOOD_PAIRS:
        say(f"Note: {used} pairs were used; at least {GOOD_PAIRS} are recommended", "yellow")
    for name, coverage in result.coverage.items():
        if coverage.empty_places or coverage.share < GOOD_COVERAGE:
            where = ", ".join(coverage.empty_places) or "many small places"
            say(
                f"Note: the {name} camera has almost no corners in: {where}. Its lens model is extrapolated there",
                "yellow",
            )
    say(
        f"At 850 mm: depth and colour agree within {accuracy.residual_mm:.2f} mm ({accuracy.residual_px:.2f} px, rms "
        f"of all corners; good: {GOOD_RESIDUAL_MM:g} mm or less)"
    )
    say(
        f"Position of a depth pixel in the colour picture: within {accuracy.alignment_mm:.2f} mm "
        f"({accuracy.alignment_px:.2f} px; good: {GOOD_ALIGNMENT_MM:g} mm or less), {accuracy.alignment_worst_mm:.2f} "
        "mm at worst in the middle of the picture"
    )
    say(f"A lateral distance of 100 mm: within {accuracy.scale_mm:.2f} mm (good: {GOOD_SCALE_MM:g} mm or less)")
    if (
        accuracy.residual_mm > GOOD_RESIDUAL_MM
        or accuracy.alignment_mm > GOOD_ALIGNMENT_MM
        or accuracy.scale_mm > GOOD_SCALE_MM
    ):
        say(
            "Note: this calibration is not good enough: take more pictures, with more tilt, sharper and nearer",
            "yellow",
        )
