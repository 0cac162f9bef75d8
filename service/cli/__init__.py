"""The command line: one module a command, imported when the command runs, so that ``--help`` is quick.

Other distributions add commands, as `tidegate-lab` does: an entry point of the group ``tidegate.commands`` names a
table like `COMMANDS`.
"""

import importlib
from functools import cache
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from service.cli.command_group import Command, CommandGroup, command_group

COMMANDS = {
    "serve": Command("service.cli.serve", "Run the service: sessions, gate, web page, HTTP API and audit log."),
    "config": Command("service.cli.config", "Print every setting with its value, and where that comes from."),
    "users": Command(
        "service.cli.access.users", "Manage the accounts of people, while no service uses the data folder."
    ),
    "keys": Command(
        "service.cli.access.keys", "Manage the API keys of machines, while no service uses the data folder."
    ),
    "measure": Command(
        "service.cli.measure.command", "Measure the breathing motion in every frame of one or more recordings."
    ),
    "info": Command("service.cli.recordings", "Print what an .oni recording contains and check it for damage."),
    "devices": Command(
        "service.cli.devices", "List the cameras, write a camera's own calibration, check a camera before it is used."
    ),
    "record": Command("service.cli.recordings", "Record depth and colour from a camera to an .oni file."),
    "convert": Command("service.cli.convert", "Convert a recording between .oni, .mcap and a folder of PNG."),
    "openapi": Command("service.cli.openapi", "Write the OpenAPI document and the schemas of the live stream."),
    "calibrate": Command(
        "service.cli.calibrate.command", "Calibrate a camera, or convert a calibration, and report its accuracy."
    ),
    "beam-line": Command("service.cli.beam_line", "Check the beam line that TIDEGATE_BEAM_LINE configures."),
    "qa": Command(
        "service.cli.qa.command", "Run QA of camera, motion, gate timing and beam line, and print its results."
    ),
    "samples": Command(
        "service.cli.samples", "List the stored samples of every session with their sizes, or verify them."
    ),
    "database": Command("service.cli.database", "Print, upgrade or downgrade the schema revision of the database."),
    "audit": Command("service.cli.audit", "Verify or export the audit log; the service may be running."),
    "backup": Command(
        "service.cli.backup", "Back up database, models, samples and tapes to one file; the service may be running."
    ),
    "restore": Command(
        "service.cli.backup", "Restore a backup into an empty database and data folder, SQLite or PostgreSQL."
    ),
    "report": Command("service.cli.report", "Write the report of a session that is over, as PDF or HTML."),
    "export": Command("service.cli.export", "Write a session for other systems: DICOM, and breathing for 4-D CT."),
    "replay": Command(
        "service.cli.replay", "Replay a stored session and compare every gate decision and sample with the original."
    ),
    "smoke": Command(
        "service.cli.smoke",
        "Check a running service from outside: certificate, readiness, version, clock, live stream.",
    ),
}
"""The commands of this distribution, in the order of the help. The function or group in the module has the command's
name with underscores; its docstring or help begins with the summary."""

GROUP = "tidegate.commands"
NO_LAB = "phantom, demo, evaluate, bench and simulate-tps come with the lab: pip install 'tidegate[lab]'"


@cache
def added_commands() -> dict[str, Command]:
    """Return the commands of other distributions that are installed, by name; none takes the place of ours."""
    from importlib.metadata import entry_points

    found: dict[str, Command] = {}
    for one in sorted(entry_points(group=GROUP), key=lambda one: one.name):
        found |= one.load()
    return {name: command for name, command in found.items() if name not in COMMANDS}


class LazyCommands(CommandGroup):
    """Imports a command's module when the command runs; the list in the help needs no import of it."""

    # `Any`: the types of the base's signatures are private to typer.
    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401, ARG002
        """Return the names of all commands, in the order of the help."""
        return [*COMMANDS, *added_commands()]

    def summaries(self, ctx: Any) -> list[tuple[str, str]]:  # noqa: ANN401, ARG002
        """Return the name and the summary of every command."""
        return [(name, command.summary) for name, command in (COMMANDS | added_commands()).items()]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401
        """Import one command; None for an unknown name."""
        command = COMMANDS.get(cmd_name) or added_commands().get(cmd_name)
        if command is None:
            self.commands = {name: TyperCommand(name) for name in self.list_commands(ctx)}  # for the suggestion
            if not added_commands():
                typer.echo(NO_LAB, err=True)
            return None
        found = getattr(importlib.import_module(command.module), cmd_name.replace("-", "_"))
        if isinstance(found, typer.Typer):
            return typer.main.get_command(found)
        program = command_group(cmd_name, command.summary)
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
