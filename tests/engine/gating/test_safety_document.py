"""docs/2-clinical/safety.md says what the code does."""

import pytest

from tests.support.documents.safety import MADE, main
from tests.support.generated_sections import PartMissingError, part_of, with_part, write_parts
from tests.support.repository import ROOT

DOCUMENT = (ROOT / "docs" / "2-clinical" / "safety.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", MADE)
def test_the_document_holds_what_the_code_makes_where_the_command_writes_it(name):
    assert part_of(DOCUMENT, name) == MADE[name]()


def test_the_command_prints_every_part(capsys):
    main([])
    printed = capsys.readouterr().out
    assert all(make() in printed for make in MADE.values())
    with pytest.raises(SystemExit, match="usage"):
        main(["--wrote"])


def test_a_part_that_is_out_of_date_is_written_anew_and_nothing_else_is_touched(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- made: tables -->\nof yesterday\n<!-- end: tables -->\nbehind\n")
    assert write_parts(page, {"tables": lambda: "of today"})
    assert page.read_text() == "before\n<!-- made: tables -->\n\nof today\n\n<!-- end: tables -->\nbehind\n"
    assert not write_parts(page, {"tables": lambda: "of today"})


@pytest.mark.parametrize(
    "text",
    ["", "<!-- made: a -->\n", "<!-- end: a -->\n<!-- made: a -->\n", "<!-- made: a -->\n<!-- end: a -->\n" * 2],
    ids=["none", "no end", "turned round", "twice"],
)
def test_a_document_without_a_place_for_a_part_is_refused(text):
    with pytest.raises(PartMissingError, match="once each"):
        with_part(text, "a", "new")
