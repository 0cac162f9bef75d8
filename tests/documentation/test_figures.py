"""The accuracy figures of the documents: a table that the command printed, of a commit and of code that are named."""

import re

import pytest

from tests.support.documents.figures import CODE, DOCUMENT, PART, accuracy, code_of_figures, stale
from tests.support.generated_sections import part_of, with_part
from tests.support.repository import ROOT

PRINTED = "sensor,plain,frames\nusual,0.1234567,100.0%\n"


@pytest.fixture
def document(tmp_path):
    page = tmp_path / DOCUMENT
    page.parent.mkdir(parents=True)
    page.write_text("<!-- made: accuracy -->\n<!-- end: accuracy -->\n")
    (tmp_path / "accuracy.csv").write_text(PRINTED)
    return page


def test_what_was_written_is_the_printed_table_of_this_code(tmp_path, document):
    assert "name no code" in stale(tmp_path)
    made = accuracy(tmp_path, "1234abcd")
    document.write_text(with_part(document.read_text(), PART, made))
    assert stale(tmp_path) is None
    assert made.splitlines()[2:] == ["| sensor | plain | frames |", "| --- | --- | --- |", "| usual | 0.123 | 100.0% |"]


def test_figures_of_other_code_are_stale(tmp_path, document):
    made = accuracy(tmp_path, "1234abcd").replace(code_of_figures(), "0123456789abcdef")
    document.write_text(with_part(document.read_text(), PART, made))
    assert "of other code (0123456789abcdef)" in stale(tmp_path)


def test_the_page_names_commit_and_code_and_has_both_sensors():
    part = part_of((ROOT / DOCUMENT).read_text(encoding="utf-8"), PART)
    assert CODE.search(part)
    assert re.search(r"at commit [0-9a-f]{7,}", part)
    rows = [line.split("|")[1].split(",")[0].strip() for line in part.splitlines() if line.startswith("| ")][2:]
    assert set(rows) == {"usual", "locking"}
