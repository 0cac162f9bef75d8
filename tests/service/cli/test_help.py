"""`--help` of every command: complete, readable as plain text, and quick."""

import re
import subprocess
import sys
from collections.abc import Iterator

import pytest
import typer
from typer.core import TyperGroup
from typer.testing import CliRunner

from service.cli import COMMANDS, added_commands, app

UNIT = re.compile(r"\[[^\]]*\]")
HEAVY = ("numpy", "cv2", "fastapi", "sqlalchemy", "pydantic", "matplotlib", "rich", "engine", "service.core")


def walk(command, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], object]]:
    """Yield every command below ``command`` with the words that call it, groups included."""
    yield path, command
    if isinstance(command, TyperGroup):
        context = typer.Context(command)
        for name in command.list_commands(context):
            yield from walk(command.get_command(context, name), (*path, name))


ALL = dict(walk(typer.main.get_command(app)))
GROUPS = [path for path, command in ALL.items() if isinstance(command, TyperGroup)]


def help_of(path: tuple[str, ...]) -> str:
    """Return what ``tidegate PATH --help`` prints."""
    done = CliRunner().invoke(app, [*path, "--help"])
    assert done.exit_code == 0, done.output
    return done.output


def squeezed(text: str) -> str:
    """Return text without white space, so that line breaks do not matter."""
    return "".join(text.split())


@pytest.fixture(scope="module", params=ALL, ids=" ".join)
def path(request):
    return request.param


@pytest.mark.parametrize("group", GROUPS, ids=" ".join)
def test_every_command_of_a_group_is_listed_by_its_name_and_its_first_sentence(group):
    shown = help_of(group)
    for name in ALL[group].list_commands(typer.Context(ALL[group])):
        below = ALL[*group, name]
        assert re.search(rf"^  {re.escape(name)} +\S", shown, re.MULTILINE), name
        assert squeezed(below.help.split("\n\n")[0]) in squeezed(shown), name


def test_every_help_text_is_printed_whole_with_its_units_in_brackets(path):
    command = ALL[path]
    shown = squeezed(help_of(path))
    assert squeezed(command.help) in shown
    for parameter in command.params:
        assert squeezed(parameter.help or "") in shown, parameter.name
    units = UNIT.findall(" ".join([command.help, *(parameter.help or "" for parameter in command.params)]))
    assert all(squeezed(unit) in shown for unit in units)


def test_completion_is_offered_by_no_command(path):
    assert "completion" not in help_of(path)


def test_a_window_in_a_help_text_is_no_emoji():
    assert "whole:-1:3" in help_of(("measure",))


def test_the_summaries_in_the_table_are_those_of_the_commands():
    """The table is printed without an import of the commands."""
    table = COMMANDS | added_commands()
    assert {name: ALL[(name,)].help.partition("\n\n")[0].replace("\n", " ") for name in table} == {
        name: command.summary for name, command in table.items()
    }


def test_without_the_lab_its_commands_are_unknown_and_it_is_named(monkeypatch):
    assert {"demo", "phantom"} <= added_commands().keys()
    monkeypatch.setattr("service.cli.added_commands", dict)
    assert "simulate-tps" not in help_of(())
    done = CliRunner().invoke(app, ["demo"])
    assert done.exit_code == 2
    assert "No such command 'demo'" in done.output
    assert "tidegate[lab]" in done.output


def test_the_help_of_the_program_imports_no_command():
    program = f"""
import sys
from service.cli import app
try:
    app(["--help"])
except SystemExit:
    print("imported:", [name for name in {HEAVY} if name in sys.modules])
    print("commands:", sorted(name for name in sys.modules if name.startswith("service.cli.")))
"""
    ran = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert ran.stdout.splitlines()[-2:] == ["imported: []", "commands: ['service.cli.command_group']"]


@pytest.mark.parametrize(
    ("words", "meant"),
    [
        (["mesure"], "measure"),
        (["beamline"], "beam-line"),
        (["qa", "dayly"], "daily"),
        (["users", "ad"], "add"),
        (["evaluate", "lazer"], "laser"),
        (["samples", "verfy"], "verify"),
    ],
    ids=" ".join,
)
def test_a_mistyped_command_is_answered_with_the_command_that_was_meant(words, meant):
    done = CliRunner().invoke(app, words)
    assert done.exit_code == 2
    assert f"No such command '{words[-1]}'. Did you mean '{meant}'" in " ".join(done.output.split())
