"""docs/2-clinical/qa.md says what the code does: its table is the code's, and its commands and settings exist."""

import re

import pytest
from typer.testing import CliRunner

from service.cli import app
from service.core.settings.settings import Settings
from tests.support.documents.qa import DOCUMENT, MADE, main
from tests.support.generated_sections import part_of

TEXT = DOCUMENT.read_text(encoding="utf-8")
COMMANDS = sorted(set(re.findall(r"tidegate qa (\w+)", TEXT)))
OPTIONS = sorted(set(re.findall(r"(?<![\w-])(--[a-z][a-z-]+)", TEXT)) - {"--write"})


@pytest.mark.parametrize("name", MADE)
def test_the_document_holds_what_the_code_makes_where_the_command_writes_it(name):
    assert part_of(TEXT, name) == MADE[name]()


def test_the_command_prints_the_table(capsys):
    main([])
    assert MADE["checks"]() in capsys.readouterr().out
    with pytest.raises(SystemExit, match="usage"):
        main(["--wrote"])


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_it_names_exists(command):
    assert CliRunner().invoke(app, ["qa", command, "--help"]).exit_code == 0


def test_every_option_it_names_exists():
    helps = [CliRunner().invoke(app, ["qa", command, "--help"], env={"COLUMNS": "300"}).stdout for command in COMMANDS]
    recorder = CliRunner().invoke(app, ["record", "--help"], env={"COLUMNS": "300"}).stdout
    known = " ".join([*helps, recorder])
    assert [option for option in OPTIONS if option not in known] == []


def test_every_setting_it_names_exists():
    named = set(re.findall(r"TIDEGATE_([A-Z_]+[A-Z])`", TEXT)) - {"QA_"}
    assert {name.lower() for name in named if "<" not in name} <= Settings.model_fields.keys()


@pytest.mark.parametrize("picture", sorted(set(re.findall(r"\]\((pictures/[\w.-]+)\)", TEXT))))
def test_every_picture_it_shows_is_there(picture):
    assert (DOCUMENT.parent / picture).is_file()
