"""The command line: one module a command, imported when it runs, so that the others cost nothing."""

import importlib
import importlib.util
from typing import Any

import typer
from typer.core import TyperGroup

HOMES = {
    "serve": "serve",
    "users": "users",
    "keys": "keys",
    "measure": "measure",
    "phantom": "phantom",
    "info": "recordings",
    "record": "recordings",
    "openapi": "openapi",
    "demo": "demo",
    "evaluate": "evaluate",
    "calibrate": "calibrate",
    "bench": "bench",
    "beam-line": "beam_line",
    "qa": "qa",
    "samples": "samples",
    "database": "database",
    "audit": "audit",
    "backup": "backup",
    "restore": "backup",
    "replay": "replay",
    "simulate-tps": "simulate_tps",
}
"""Which module of this package holds which command; the function, or the group of commands, has the command's name with
underscores for dashes."""


class LazyCommands(TyperGroup):
    """Imports a command's module when the command is asked for."""

    # `Any`: the types of the base's signatures are private to typer.
    def list_commands(self, ctx: Any) -> list[str]:  # noqa: ANN401, ARG002
        """List the commands that are installed."""
        return [name for name, home in HOMES.items() if importlib.util.find_spec(f"{__name__}.{home}") is not None]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:  # noqa: ANN401
        """Import one command."""
        if cmd_name not in self.list_commands(ctx):
            return None
        module = importlib.import_module(f"{__name__}.{HOMES[cmd_name]}")
        held = getattr(module, cmd_name.replace("-", "_"))
        if isinstance(held, typer.Typer):
            return typer.main.get_command(held)
        single = typer.Typer(add_completion=False, pretty_exceptions_show_locals=False)
        single.command(cmd_name)(held)
        return typer.main.get_command(single)


app = typer.Typer(
    name="tidegate",
    cls=LazyCommands,
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_show_locals=False,
)


@app.callback()
def tidegate() -> None:
    """Respiratory gating for research and commissioning; not cleared for clinical use."""


def main() -> None:
    """Run the command line."""
    app()
