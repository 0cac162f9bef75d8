"""The figures of the documents: tables that commands printed, of a commit and of code that are named."""

import re

import pytest

from tests.support.documents import ages
from tests.support.documents.figures import (
    CODE,
    DOCUMENT,
    SOURCES,
    accuracy,
    budget,
    code_of,
    hazards,
    integrity,
    stale,
)
from tests.support.generated_sections import part_of, with_part
from tests.support.repository import ROOT

PRINTED = "sensor,plain,frames\nusual,0.1234567,100.0%\n"
HEAD = "kind,size,hazard,measured [%],longest [s],largest error [mm],named after [s],of it outside [s],misses\n"
USUAL = HEAD + "sheet,2 mm,S2,99.51,7.90,2.71,,0.0,stands\nhonest,,,100.0,0.0,0.3,,0.0,\n"
LOCKING = HEAD + "sheet,2 mm,S2,4.0,0.3,2.7,0.333,0.07,\nhonest,,,98.0,0.0,0.3,,0.0,\n"


@pytest.fixture
def document(tmp_path):
    page = tmp_path / DOCUMENT
    page.parent.mkdir(parents=True)
    page.write_text("".join(f"<!-- made: {part} -->\n<!-- end: {part} -->\n" for part in SOURCES))
    for name, text in (
        ("accuracy", PRINTED),
        ("budget", PRINTED),
        ("integrity_usual", USUAL),
        ("integrity_locking", LOCKING),
    ):
        (tmp_path / f"{name}.csv").write_text(text)
    return page


def written(document, tmp_path):
    for part, make in (("accuracy", accuracy), ("budget", budget), ("integrity", integrity)):
        document.write_text(with_part(document.read_text(), part, make(tmp_path, "1234abcd")))


def test_what_was_written_is_the_printed_table_of_this_code(tmp_path, document):
    assert "the figures of accuracy name no code" in stale(tmp_path)
    written(document, tmp_path)
    assert stale(tmp_path) is None
    made = accuracy(tmp_path, "1234abcd").splitlines()
    assert made[2:] == ["| sensor | plain | frames |", "| --- | --- | --- |", "| usual | 0.123 | 100.0% |"]


def test_of_the_falsifications_those_stand_there_that_miss_a_target_on_a_sensor(tmp_path, document):
    made = integrity(tmp_path, "1234abcd")
    assert "of 2 falsifications and honest recordings 1 meet every target on both sensors" in made
    assert "for at most 0.07 s" in made
    row = "| sheet, 2 mm | 100; 7.90; 2.7; not by all | stands | 4; 0.30; 2.7; 0.33 | none |"
    assert made.splitlines()[2:] == ["| falsification | usual | misses | locking | misses |", f"|{' --- |' * 5}", row]


def test_each_hazard_has_its_figures_on_both_sensors(tmp_path, document):
    made = hazards(tmp_path, "1234abcd").splitlines()
    assert made[2:] == [
        "| hazard | usual | locking |",
        "| --- | --- | --- |",
        "| S2 | 0 of 1; 7.90; 0.00 | 1 of 1; 0.30; 0.07 |",
    ]


@pytest.mark.parametrize("part", SOURCES)
def test_figures_of_other_code_are_stale(tmp_path, document, part):
    written(document, tmp_path)
    text = document.read_text()
    document.write_text(text.replace(code_of(part), "0123456789abcdef"))
    assert "are of other code (0123456789abcdef)" in stale(tmp_path)


@pytest.mark.parametrize("part", SOURCES)
def test_the_page_names_commit_and_code(part):
    text = part_of((ROOT / DOCUMENT).read_text(encoding="utf-8"), part)
    assert CODE.search(text)
    assert re.search(r"at commit [0-9a-f]{7,}", text)


def test_the_page_has_both_sensors():
    part = part_of((ROOT / DOCUMENT).read_text(encoding="utf-8"), "accuracy")
    rows = [line.split("|")[1].split(",")[0].strip() for line in part.splitlines() if line.startswith("| ")][2:]
    assert set(rows) == {"usual", "locking"}


def test_a_page_states_the_age_of_old_figures(tmp_path, monkeypatch):
    since = {"22ffe73": 508, "3047e4dd": ages.OLD - 1, "abcdef01": None}
    monkeypatch.setattr(ages, "commits_since", since.get)
    assert ages.with_ages("printed at commit 22ffe73 (mm)") == "printed at commit 22ffe73 (**508 commits ago**) (mm)"
    young = ("At 3047e4dd, 20 runs", "at commit abcdef01", "of decades, at 1234567890123456")
    for text in young:
        assert ages.with_ages(text) == text
    page = tmp_path / "docs" / "5-evidence" / "page.md"
    page.parent.mkdir(parents=True)
    page.write_text(f"{' '.join(young)}: printed at commit `22ffe73` (mm)")
    monkeypatch.setattr(ages, "ROOT", tmp_path)
    named = [line for line in ages.old() if "page.md" in line]
    assert named == [f"{page.relative_to(tmp_path)}: figures of 22ffe73, 508 commits ago"]
