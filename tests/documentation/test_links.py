"""The documentation: every page is in the index, every link and every path in a page leads to a file."""

import re
from pathlib import Path

import pytest

from tests.support.repository import ROOT

DOCS = ROOT / "docs"
PAGES = sorted([*DOCS.rglob("*.md"), ROOT / "README.md"])
LINK = re.compile(r"\]\((?!https?:|mailto:)([^)\s#]*)(?:#([\w-]*))?\)")
NAMED_PAGE = re.compile(r"\bdocs/[\w./-]+\.(?:md|sh|cs|png)\b")


def links_of(page: Path) -> list[str]:
    """Every file that a page links to, relative to its folder."""
    return [target for target, _ in LINK.findall(page.read_text(encoding="utf-8")) if target]


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_link_leads_to_a_file(page):
    assert [target for target in links_of(page) if not (page.parent / target).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_page_that_is_named_exists(page):
    named = set(NAMED_PAGE.findall(page.read_text(encoding="utf-8")))
    assert [path for path in sorted(named) if not (ROOT / path).is_file()] == []


def test_the_index_leads_to_every_page():
    index = DOCS / "README.md"
    listed = {(index.parent / target).resolve() for target in links_of(index)}
    decisions = {page for page in PAGES if page.parent.name == "adr" and page.name != "README.md"}
    assert {page for page in PAGES if page.parent != ROOT} - decisions - {index} <= listed


def test_the_index_of_decisions_leads_to_every_decision():
    index = DOCS / "adr" / "README.md"
    assert set(links_of(index)) == {page.name for page in index.parent.glob("0*.md")}


def test_every_page_that_the_code_names_exists():
    sources = [path for folder in ("engine", "service", "lab", "tests") for path in (ROOT / folder).rglob("*.py")]
    named = {(path, page) for path in sources for page in NAMED_PAGE.findall(path.read_text(encoding="utf-8"))}
    assert sorted(f"{path.name}: {page}" for path, page in named if not (ROOT / page).is_file()) == []
