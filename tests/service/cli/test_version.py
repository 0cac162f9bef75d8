"""The version names the frame path that runs."""

from typer.testing import CliRunner

from engine import __version__
from engine.core import compiled
from service.cli import app


def test_the_version_names_the_path_that_runs():
    said = CliRunner().invoke(app, ["--version"])
    assert (said.exit_code, said.output) == (0, f"tidegate {__version__}, frame path: {compiled.frame_path()}\n")
    with compiled.numpy_forms():
        assert "numpy" in CliRunner().invoke(app, ["--version"]).output
