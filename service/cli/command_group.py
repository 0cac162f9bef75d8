"""Groups of commands: help as plain text, a suggestion for a mistyped name, no shell completion.

Rich markup stays off: it removes units in brackets such as [mm] from help texts and turns ``whole:-1:3`` into an emoji.
"""

from typing import Any, NamedTuple

import typer
from typer.core import TyperGroup

HELP_WIDTH = 100
"""Longest line of a help text [characters]; a narrower terminal has shorter ones."""


class Command(NamedTuple):
    """A command: its module and its line in ``tidegate --help``."""

    module: str
    summary: str


class CommandGroup(TyperGroup):
    """Lists its commands with the whole first sentence of each."""

    # `Any`: the types of the base's signatures are private to typer.
    def summaries(self, ctx: Any) -> list[tuple[str, str]]:  # noqa: ANN401
        """Return the name and the first paragraph of the help of every command."""
        commands = [(name, self.get_command(ctx, name)) for name in self.list_commands(ctx)]
        return [(name, first_paragraph(command.help)) for name, command in commands if command is not None]

    def format_commands(self, ctx: Any, formatter: Any) -> None:  # noqa: ANN401
        """Write the list of commands into the help."""
        with formatter.section("Commands"):
            formatter.write_dl(self.summaries(ctx))


def first_paragraph(text: str | None) -> str:
    """Return the first paragraph of a help text on one line."""
    return " ".join((text or "").strip().partition("\n\n")[0].split())


def command_group(name: str, summary: str, *, cls: type[CommandGroup] = CommandGroup) -> typer.Typer:
    """Return a group without commands; ``summary`` is its help."""
    return typer.Typer(
        name=name,
        help=summary,
        cls=cls,
        no_args_is_help=True,
        add_completion=False,
        rich_markup_mode=None,
        pretty_exceptions_show_locals=False,
        context_settings={"max_content_width": HELP_WIDTH},
    )
