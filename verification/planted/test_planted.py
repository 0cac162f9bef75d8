"""The table of planted faults fits the sources: each mechanism is where it is broken, and its test exists."""

import ast

import pytest

from tests.support.repository import ROOT
from verification.planted.planted import PLANTED, broken, outcome_of


@pytest.mark.parametrize("one", PLANTED, ids=lambda one: one.what)
def test_the_mechanism_is_there_still_compiles_broken_and_its_test_exists(one):
    whole = (ROOT / one.file).read_text(encoding="utf-8")
    changed = broken(one, whole)
    assert changed != whole
    ast.parse(changed)
    path, name = one.test.split("::")
    functions = {
        node.name
        for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef)
    }
    assert name in functions


@pytest.mark.parametrize(("new", "outcome"), [("2", "fails"), ("1", "PASSES"), ("(", "NOT RUN")])
def test_a_test_that_fails_passes_or_does_not_run_is_reported_apart(tmp_path, new, outcome):
    (tmp_path / "made.py").write_text("ONE = 1\n")
    (tmp_path / "test_made.py").write_text("from made import ONE\n\n\ndef test_one():\n    assert ONE == 1\n")
    one = PLANTED[0].__class__(what="one", file="made.py", old="= 1", new=f"= {new}", test="test_made.py::test_one")
    assert outcome_of(one, tmp_path) == outcome
    assert (tmp_path / "made.py").read_text() == "ONE = 1\n"


def test_a_mechanism_that_has_moved_is_named():
    with pytest.raises(ValueError, match="no longer has"):
        broken(PLANTED[0], "nothing")
