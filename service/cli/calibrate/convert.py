"""``tidegate calibrate convert``: convert a calibration of OpenCV or ROS.

The serial number that a calibration is written with.
"""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from engine.calibration import STRICT, Calibration
from engine.core.files import write_whole
from service.cli.terminal import refused, say

SerialOption = Annotated[
    str | None,
    typer.Option(
        help="Serial number of this camera, as the session shows it: a session then notices another camera, and "
        "clinical mode refuses it. By default that of the input, if it has one."
    ),
]
NAME = "calibrate convert"


def with_serial(calibration: Calibration, serial: str | None) -> Calibration:
    """Return the calibration with this serial number; raise CalibrationError if it is no printable text."""
    return calibration if serial is None else replace(calibration, serial=STRICT.name("serial", serial))


def convert(
    files: Annotated[
        list[Path],
        typer.Argument(help="An OpenCV FileStorage, two ROS camera_info files, or a tidegate.calibration/1."),
    ],
    *,
    out: Annotated[Path, typer.Option(help="Calibration to write (tidegate.calibration/1).")],
    camera: Annotated[str | None, typer.Option(help="Name of the camera, if the files contain none.")] = None,
    first_camera: Annotated[
        str | None, typer.Option(help="depth or color: the camera of M1, or of the first camera_info file.")
    ] = None,
    translation_unit: Annotated[str | None, typer.Option(help="mm or m: unit of OpenCV's T.")] = None,
    size: Annotated[
        str | None,
        typer.Option(help="WIDTHxHEIGHT of the pictures of both cameras, if the files do not contain it [px]."),
    ] = None,
    baseline_mm: Annotated[
        float | None,
        typer.Option(help="For camera_info without a pose: x of the depth camera in the colour camera's frame [mm]."),
    ] = None,
    pose: Annotated[
        Path | None,
        typer.Option(help="JSON file with rotation (3 x 3) and translation_mm, if the files contain no pose."),
    ] = None,
    is_mirrored: Annotated[
        bool,
        typer.Option(
            "--mirrored",
            help="The pictures it was made with were mirrored, as most drivers deliver them: convert it for pictures "
            "that are not. Recordings are played and measured unmirrored.",
        ),
    ] = False,
    serial: SerialOption = None,
) -> None:
    """Convert a calibration; an ambiguous file is refused until an option resolves it."""
    from engine.calibration import STRICT
    from engine.calibration.formats import convert, options_of
    from engine.core.errors import TidegateError

    beside: dict[str, object] = {
        "camera": camera,
        "first_camera": first_camera,
        "translation_unit": translation_unit,
        "baseline_mm": baseline_mm,
    }
    try:
        beside["image_size_px"] = None if size is None else _size(size)
        beside["depth_to_color"] = None if pose is None else STRICT.load(pose)
        options = options_of(beside)
        converted = convert([STRICT.read_bytes(file) for file in files], options)
        out.parent.mkdir(parents=True, exist_ok=True)
        calibration = converted.calibration.of_mirrored_pictures() if is_mirrored else converted.calibration
        write_whole(out, with_serial(calibration, serial).to_json().encode())
    except TidegateError as error:
        raise refused(NAME, error) from error
    except OSError as error:
        raise refused(NAME, f"{out} cannot be written ({error.strerror or error})") from error
    for note in converted.notes:
        say(f"Note: {note}", "yellow")
    say(f"{out}: {converted.calibration.camera}, from {converted.format}")


def _size(text: str) -> list[object]:
    """Read WIDTHxHEIGHT; the format refuses parts that are not numbers."""
    return [
        int(part) if part.isascii() and part.isdigit() and len(part) < 6 else part for part in text.lower().split("x")
    ]
