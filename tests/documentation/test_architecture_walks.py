"""The walks of docs/1-start/architecture.md: every file exists and defines the function that the walk names."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "1-start" / "architecture.md"
WALK = re.compile(r"<!-- walk: (.+?) -->\n(.*?)<!-- end -->", re.DOTALL)
STEP = re.compile(r"^(\d+)\. `([\w/]+\.py)` `(\w+)`: .+$")
WALKS = dict(WALK.findall(PAGE.read_text(encoding="utf-8")))


def functions_of(path: Path) -> set[str]:
    """The names of all functions and methods that a file defines."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    return {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)}


def test_there_are_four_walks():
    assert list(WALKS) == ["a frame", "an arm call", "a transition", "a live sample"]


@pytest.mark.parametrize("name", WALKS)
def test_every_step_names_a_file_and_a_function_that_exist(name):
    steps = [STEP.fullmatch(line) for line in WALKS[name].splitlines()]
    assert all(steps)
    found = [step.groups() for step in steps if step is not None]
    assert [int(number) for number, _, _ in found] == list(range(1, len(found) + 1))
    missing = [
        f"{path} {function}"
        for _, path, function in found
        if not (ROOT / path).is_file() or function not in functions_of(ROOT / path)
    ]
    assert missing == []
