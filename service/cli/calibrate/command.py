"""``tidegate calibrate``: make and check a camera calibration; one module per subcommand."""

from service.cli.calibrate.checkerboard import checkerboard
from service.cli.calibrate.convert import convert
from service.cli.calibrate.plate import plate
from service.cli.command_group import command_group

calibrate = command_group("calibrate", "Calibrate a camera, or convert a calibration, and report its accuracy.")
calibrate.command("checkerboard")(checkerboard)
calibrate.command("plate")(plate)
calibrate.command("convert")(convert)
