"""The serial number that a calibration is written with."""

from dataclasses import replace
from typing import Annotated

import typer

from engine.calibration.camera_calibration import STRICT, Calibration

SerialOption = Annotated[
    str | None,
    typer.Option(
        help="Serial number of this camera, as the session shows it: a session then notices another camera, and "
        "clinical mode refuses it. By default that of the input, if it has one."
    ),
]


def with_serial(calibration: Calibration, serial: str | None) -> Calibration:
    """Return the calibration with this serial number; raise CalibrationError if it is no printable text."""
    return calibration if serial is None else replace(calibration, serial=STRICT.name("serial", serial))
