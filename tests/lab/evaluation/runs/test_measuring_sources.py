"""A cached measurement is measured again when code that it depends on changes: the globs of that code cover it."""

import ast
from pathlib import Path

import pytest

from lab.evaluation.runs.trial import MEASURING_SOURCES
from tests.support.repository import ROOT

NOT_MEASURING = {"lab/evaluation/runs/datasets.py"}
"""Makes recordings, with a recipe of their own; the phantom likewise."""


def imported_by(path: Path) -> set[Path]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module is not None:
            names |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        elif isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
    stems = [ROOT / name.replace(".", "/") for name in names if name.startswith(("engine.", "lab."))]
    files = {file for stem in stems for file in (stem.with_suffix(".py"), stem / "__init__.py")}
    return {file for file in files if file.is_file()}


def imported_in_the_end_by(path: Path) -> set[Path]:
    found, left = {path}, [path]
    while left:
        new = {other for other in imported_by(left.pop()) if is_measuring(other)} - found
        found |= new
        left += new
    return found


def is_measuring(path: Path) -> bool:
    name = path.relative_to(ROOT).as_posix()
    return not name.startswith("lab/phantom/") and name not in NOT_MEASURING


@pytest.mark.parametrize("pattern", MEASURING_SOURCES)
def test_every_pattern_matches_a_file(pattern):
    assert [path for path in ROOT.glob(pattern) if path.is_file()]


def test_the_patterns_cover_every_module_that_a_measurement_imports():
    covered = {path for pattern in MEASURING_SOURCES for path in ROOT.glob(pattern)}
    needed = imported_in_the_end_by(ROOT / "lab/evaluation/runs/trial.py")
    assert len(needed) > 50
    assert {path.relative_to(ROOT).as_posix() for path in needed - covered} == set()


def test_the_phantom_s_pattern_matches_its_modules():
    assert len(list(ROOT.glob("lab/phantom/*.py"))) > 15
