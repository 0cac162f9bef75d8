"""The glossary: unique words in alphabetical order, each explained in one sentence."""

import re

import pytest

from tests.support.repository import ROOT

PAGE = ROOT / "docs" / "1-start" / "glossary.md"
ROWS = re.findall(r"^\| \*\*(.+?)\*\* \| (.+) \|$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
WORDS = [word for word, _ in ROWS]


def test_words_are_unique_and_sorted():
    assert len(WORDS) >= 30
    assert sorted(set(WORDS), key=str.lower) == WORDS


@pytest.mark.parametrize(("word", "meaning"), ROWS, ids=WORDS)
def test_each_word_is_explained_in_one_sentence(word, meaning):
    assert re.fullmatch(r"[A-Z][^.?!]*\.", meaning), f"{word}: {meaning}"
