"""Run a command of the command line in this process."""

from typer.testing import CliRunner

from service.cli import app


def invoke(folder, out, *extra):
    arguments = ["measure", str(folder / "recording.oni"), "--calibration", str(folder / "calibration.json")]
    return CliRunner().invoke(app, [*arguments, "--out", str(out), *extra])
