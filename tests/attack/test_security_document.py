"""docs/security.md tells the bounds, the headers and the fuzzing as they are, and names only tests that exist."""

import re
from pathlib import Path

import pytest

from tests.attack.security_document import DOCUMENT, MADE
from tests.made_parts import are_as_made

TOP = Path(__file__).parents[2]
TEXT = DOCUMENT.read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`(tests/[a-z_/]+\.py)::(test_\w+)`", TEXT)))


def test_the_generated_parts_are_as_the_code_has_them():
    assert are_as_made(DOCUMENT, MADE), "python -m tests.attack.security_document --write"


@pytest.mark.parametrize(("file", "test"), NAMED, ids=lambda one: one.rpartition("/")[2][:60])
def test_every_test_it_names_is_there(file, test):
    assert f"def {test}(" in (TOP / file).read_text(encoding="utf-8")


def test_it_names_a_test_for_every_threat():
    rows = [line for line in TEXT.partition("## Threats")[2].partition("\n\n")[0].splitlines()[3:] if line]
    assert len(rows) >= 12
    assert all("`tests/" in row for row in rows)
