"""docs/3-operate/security.md gives the bounds, headers and fuzzing of the code, and names only tests that exist."""

import re

import pytest

from tests.support.generated_sections import are_as_made
from tests.support.repository import ROOT
from verification.attack.security_document import DOCUMENT, MADE

TEXT = DOCUMENT.read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`((?:tests|verification)/[a-z_/]+\.py)::(test_\w+)`", TEXT)))


def test_the_generated_parts_are_as_the_code_has_them():
    assert are_as_made(DOCUMENT, MADE), "python -m verification.attack.security_document --write"


@pytest.mark.parametrize(("file", "test"), NAMED, ids=lambda one: one.rpartition("/")[2][:60])
def test_every_test_it_names_is_there(file, test):
    assert f"def {test}(" in (ROOT / file).read_text(encoding="utf-8")


def test_it_names_a_test_for_every_threat():
    rows = [line for line in TEXT.partition("## Threats")[2].partition("\n\n")[0].splitlines()[3:] if line]
    assert len(rows) >= 12
    assert all(re.search("`(tests|verification)/", row) for row in rows)
