"""docs/safety.md says what the code does, and names tests that exist."""

import re
from pathlib import Path

import pytest

from tests.gate.safety_document import interlock_table, reason_lists, transition_table

ROOT = Path(__file__).parents[2]
DOCUMENT = (ROOT / "docs" / "safety.md").read_text(encoding="utf-8")
NAMED_TESTS = sorted(set(re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", DOCUMENT)))


@pytest.mark.parametrize("made", [transition_table, reason_lists, interlock_table], ids=lambda made: made.__name__)
def test_the_document_holds_the_tables_the_code_makes(made):
    assert made() in DOCUMENT


def test_every_rule_names_tests():
    rules = re.findall(r"^\| \*\*(\d)\*\* \|.*$", DOCUMENT, flags=re.MULTILINE)
    assert rules == list("12345678")
    for line in re.findall(r"^\| \*\*\d\*\* \|.*$", DOCUMENT, flags=re.MULTILINE):
        assert re.search(r"tests/[\w/]+\.py", line), line


@pytest.mark.parametrize(("path", "name"), NAMED_TESTS)
def test_every_named_test_exists(path, name):
    assert f"def {name}(" in (ROOT / path).read_text(encoding="utf-8")
