"""The command line: one module a command, imported when the command runs, so that ``--help`` is quick."""

import importlib
from typing import Annotated, Any, NamedTuple

import typer
from typer.core import TyperCommand

from service.cli.command_group import CommandGroup, command_group


class Command(NamedTuple):
    """A command: its module in this package and its line in ``tidegate --help``."""

    module: str
    summary: str


COMMANDS = {
    "serve": Command("serve", "Run the service: sessions, gate, web page, HTTP API and audit log."),
    "config": Command("config", "Print every setting with its value, and where that comes from."),
    "users": Command("access.users", "Manage the accounts of people, while no service uses the data folder."),
    "keys": Command("access.keys", "Manage the API keys of machines, while no service uses the data folder."),
    "measure": Command("measure.command", "Measure the breathing motion in every frame of one or more recordings."),
    "phantom": Command("phantom", "Generate a recording of a virtual volunteer, with its calibration and true motion."),
    "info": Command("recordings", "Print what an .oni recording contains and check it for damage."),
    "devices": Command(
        "devices", "List the cameras, write a camera's own calibration, check a camera before it is used."
    ),
    "record": Command("recordings", "Record depth and colour from a camera to an .oni file."),
    "openapi": Command("openapi", "Write the OpenAPI document and the schemas of the live stream."),
    "demo": Command("demo.command", "Run a gated session on a virtual volunteer and compare it with the true motion."),
    "evaluate": Command(
        "evaluate.command", "Measure the accuracy of the motion on virtual volunteers and against instruments."
    ),
    "calibrate": Command("calibrate.command", "Calibrate a camera, or convert a calibration, and report its accuracy."),
    "bench": Command("bench", "Measure the speed of every processing stage and the memory use on this machine."),
    "beam-line": Command("beam_line", "Check the beam line that TIDEGATE_BEAM_LINE configures."),
    "qa": Command("qa.command", "Run QA of camera, motion, gate timing and beam line, and print its results."),
    "samples": Command("samples", "List the stored samples of every session with their sizes, or verify them."),
    "database": Command("database", "Print, upgrade or downgrade the schema revision of the database."),
    "audit": Command("audit", "Verify or export the audit log; the service may be running."),
    "backup": Command("backup", "Back up database, models, samples and tapes to one file; the service may be running."),
    "restore": Command("backup", "Restore a backup into an empty database and data folder, SQLite or PostgreSQL."),
    "report": Command("report", "Write the report of a session that is over, as PDF or HTML."),
    "replay": Command(
        "replay", "Replay a stored session and compare every gate decision and sample with the original."
    ),
    "smoke": Command(
        "smoke", "Check a running service from outside: certificate, readiness, version, clock, live stream."
    ),
    "simulate-tps": Command(
        "simulate_tps", "Simulate a treatment planning system: run whole fractions against a running service."
    ),
}
"""Every command, in the order of the help. The function or group in the module has the command's name with underscores;
its docstring or help begins with the summary."""


class LazyCommands(CommandGroup):
    """Imports a command's module when the command runs; the list in the help needs no import."""

    def __init__(self, **attributes: Any) -> None:  # noqa: ANN401 - the base's, private to typer
        super().__init__(**attributes)
        self.commands = {name: TyperCommand(name, help=command.summary) for name, command in COMMANDS.items()}

    def summaries(self, ctx: Any) -> list[tuple[str, str]]:  # noqa: ANN401, ARG002
        """Return the name and the summary of every command."""
        return [(name, command.summary) for name, command in COMMANDS.items()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401, ARG002
        """Import one command; None for an unknown name."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"{__name__}.{COMMANDS[cmd_name].module}")
        found = getattr(module, cmd_name.replace("-", "_"))
        if isinstance(found, typer.Typer):
            return typer.main.get_command(found)
        program = command_group(cmd_name, COMMANDS[cmd_name].summary)
        program.command(cmd_name)(found)
        return typer.main.get_command(program)


app = command_group(
    "tidegate", "Respiratory gating for research and commissioning; not cleared for clinical use.", cls=LazyCommands
)


def _print_version(is_wanted: bool) -> None:  # noqa: FBT001 - typer's signature
    if not is_wanted:
        return
    from engine import __version__
    from engine.core.compiled import frame_path

    typer.echo(f"tidegate {__version__}, frame path: {frame_path()}")
    raise typer.Exit


@app.callback()
def tidegate(
    *,
    _version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Print the version and which frame path runs."
        ),
    ] = False,
) -> None:
    """Make the program a group, although its commands are not registered with typer."""


def main() -> None:
    """Run the command line."""
    app()
