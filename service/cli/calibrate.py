"""``tidegate calibrate``: makes a camera's calibration, and says how good it is; one module a subcommand."""

import typer

from service.cli.calibrate_checkerboard import checkerboard
from service.cli.calibrate_convert import convert
from service.cli.calibrate_plate import plate

calibrate = typer.Typer(
    name="calibrate",
    help="Make a camera's calibration, and say how good it is.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,
)
calibrate.command("checkerboard")(checkerboard)
calibrate.command("plate")(plate)
calibrate.command("convert")(convert)
