"""``tidegate calibrate convert``: a calibration of OpenCV or ROS to ours."""

from pathlib import Path
from typing import Annotated

import typer

from service.cli.terminal import refused, say
from service.cli.written import write_whole

NAME = "calibrate convert"


def convert(
    files: Annotated[list[Path], typer.Argument(help="OpenCV FileStorage, or two ROS camera_info; or one of ours.")],
    *,
    out: Annotated[Path, typer.Option(help="The calibration to write (tidegate.calibration/1).")],
    camera: Annotated[str | None, typer.Option(help="The camera's name, where the files have none.")] = None,
    first_camera: Annotated[
        str | None, typer.Option(help="depth or color: whose M1 is, or the first of two camera_info files.")
    ] = None,
    translation_unit: Annotated[str | None, typer.Option(help="mm or m: the unit of OpenCV's T.")] = None,
    size: Annotated[
        str | None, typer.Option(help="WIDTHxHEIGHT of both cameras' pictures, where the files do not say.")
    ] = None,
    baseline_mm: Annotated[
        float | None,
        typer.Option(help="Of camera_info without a pose: x of the depth camera in the colour camera's frame."),
    ] = None,
    pose: Annotated[
        Path | None,
        typer.Option(help="JSON file with rotation (3 x 3) and translation_mm, where the files have none."),
    ] = None,
) -> None:
    """Convert a calibration; what is ambiguous is asked for, never guessed."""
    from engine.calibration_formats import convert as formats
    from engine.calibration_formats.documents import STRICT
    from engine.errors import TidegateError

    beside: dict[str, object] = {
        "camera": camera,
        "first_camera": first_camera,
        "translation_unit": translation_unit,
        "baseline_mm": baseline_mm,
    }
    try:
        beside["image_size_px"] = None if size is None else _size(size)
        beside["depth_to_color"] = None if pose is None else STRICT.load(pose)
        options = formats.options_of(beside)
        converted = formats.convert([STRICT.read_bytes(file) for file in files], options)
        write_whole(out, converted.calibration.to_json().encode())
    except TidegateError as error:
        raise refused(NAME, error) from error
    except OSError as error:
        raise refused(NAME, f"{out} cannot be written ({error.strerror or error})") from error
    for note in converted.notes:
        say(f"Mind: {note}", "yellow")
    say(f"{out}: {converted.calibration.camera}, from {converted.format}")


def _size(text: str) -> list[object]:
    """Take WIDTHxHEIGHT; what is no number is refused later, by name."""
    return [
        int(part) if part.isascii() and part.isdigit() and len(part) < 6 else part for part in text.lower().split("x")
    ]
