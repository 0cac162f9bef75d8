"""Every command in the documents exists, with the options that it is given there.

README's session with curl is run in tests/system/service/test_readme_walk.py, and the sample clients are; the others
need a machine as their guide describes it.
"""

import importlib.util
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from service.cli import app
from service.core.permissions import KEY_PERMISSIONS, Role
from tests.support.repository import ROOT

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
ROOT_COMMAND = typer.main.get_command(app)
TARGETS = set(re.findall(r"^([a-z][a-z-]*):", (ROOT / "Makefile").read_text(), re.MULTILINE))
CHECKED = {"--role": [*Role], "--scope": [*KEY_PERMISSIONS]}
BLOCK = re.compile(r"^```[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
SPAN = re.compile(r"`([^`\n]+)`")
STOPS = re.compile(r"\s(?:[|;>&]|&&|#).*$")
NO_WORD = re.compile(r"[:=]")
PLACEHOLDER = re.compile(r"[A-Z][A-Z_0-9-]*\b|\.\.\.|\$|<|/")


def commands(page: Path, program: str) -> Iterator[list[str]]:
    """Yield the arguments of each call of a program on a page, in code blocks and in the text."""
    text = page.read_text().replace("\\\n", " ")
    lines = [line for block in BLOCK.findall(text) for line in block.splitlines()]
    lines += SPAN.findall(BLOCK.sub("", text))
    for line in lines:
        found = re.match(rf"(?:\$ |# |sudo |nice |[A-Z_]+=\S+ |docker \S+ (?:-\S+ )*\S+ )*{program} (.*)", line.strip())
        if found is not None:
            arguments = shlex.split(STOPS.sub("", found[1] + " ").strip().replace("…", ""))
            if arguments and not NO_WORD.search(arguments[0]):  # a message of the program, or a variable of that name
                yield arguments


def refused(arguments: list[str]) -> str:
    """Return why the command line would refuse these arguments; placeholders of values are accepted."""
    command, context = ROOT_COMMAND, ROOT_COMMAND.make_context("tidegate", ["--help"], resilient_parsing=True)
    while hasattr(command, "get_command") and arguments and not arguments[0].startswith("-"):
        name, *arguments = arguments
        if PLACEHOLDER.match(name):
            return ""
        command = command.get_command(context, name)
        if command is None:
            return f"no command {name}"
        context = type(context)(command, parent=context, info_name=name)
    options = {flag: one for one in command.params for flag in (*one.opts, *one.secondary_opts)}
    for at, word in enumerate(arguments):
        flag, _, joined = word.partition("=")
        if not word.startswith("--"):
            continue
        if flag not in {*options, "--help", "--version"}:
            return f"no option {flag} of {context.command_path}"
        option = options.get(flag)
        given = joined or (arguments[at + 1] if at + 1 < len(arguments) else "")
        choices = CHECKED.get(flag) or [str(one) for one in getattr(getattr(option, "type", None), "choices", ())]
        if choices and given != "" and not PLACEHOLDER.match(given) and given not in choices:
            return f"{flag} {given}: one of {', '.join(choices)}"
    return ""


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_command_is_accepted(page: Path):
    wrong = {" ".join(one): why for one in commands(page, "tidegate") if (why := refused(one))}
    assert wrong == {}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_every_module_and_every_target_exists(page: Path):
    modules = {one[0] for one in commands(page, r"(?:nice -n \d+ )?(?:\.venv/bin/)?python3? -m") if one}
    assert {one for one in modules if not PLACEHOLDER.match(one) and importlib.util.find_spec(one) is None} == set()
    targets = {word for one in commands(page, "make") for word in one if re.fullmatch(r"[a-z][a-z-]*", word)}
    assert targets - TARGETS == set()


def test_a_wrong_role_command_or_option_is_found():
    assert refused(["users", "add", "NAME", "--role", "administrator"]) != ""
    assert refused(["users", "add", "NAME", "--role", "admin"]) == ""
    assert refused(["user", "add"]) == "no command user"
    assert refused(["serve", "--prot", "80"]) == "no option --prot of tidegate serve"


def test_the_pages_name_many_commands():
    assert sum(len(list(commands(page, "tidegate"))) for page in PAGES) > 100
