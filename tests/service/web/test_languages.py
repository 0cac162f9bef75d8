"""The page's words: every language has all of them, each code of the controller is explained, none is hard-coded."""

import json
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from starlette.applications import Starlette
from starlette.testclient import TestClient

from engine.core.frames import Mover
from engine.core.gate_state import GateState, HoldReason
from engine.core.learning_status import LearningEventKind
from service.core.alarm_table import ALARMS
from service.web.app import DASHBOARD, LANGUAGE_LIST, language_names, language_route
from tests.support.documents.audit_routes import audited
from tests.support.documents.sentences import PREFIX, templates

LANGUAGES = {name: json.loads((DASHBOARD / "lang" / f"{name}.json").read_text()) for name in language_names(DASHBOARD)}
ENGLISH = LANGUAGES["en"]
SCRIPTS = [file for file in (DASHBOARD / "js").rglob("*.js") if file.name != "words.js"]
PAGES = [DASHBOARD / "nothing.html", *(DASHBOARD / place / "index.html" for place in (".", "patient", "office"))]
CODES = [*HoldReason, *(code for code in ALARMS if code not in set(HoldReason))]
NAMES = {"Tidegate", "F8", "Esc", "Tab", "Enter", "L", "End", "mm", "s", "OpenNI2 runtime"}
"""Text of the document that is the same in every language: names, keys and units."""
MADE_OF = {
    *("action.", "alarm.", "arming.group.", "qa.", "role.", PREFIX),
    *("office.", "review.", "scope.", "checks.", "event.", "theme."),
    *("hold.", "lamp.", "moved.", "patient.", "reason.unknown"),
    *("signal.", "simulation.origin.", "sound.", "status.", "tables.kind.", "to."),
}
"""Keys that the scripts put together from a code."""


def placeholders(text: str) -> list[str]:
    return sorted(re.findall(r"\{(\w+)\}", text))


def test_english_and_german_are_there():
    assert {"de", "en"} <= set(LANGUAGES)


@pytest.mark.parametrize("name", LANGUAGES)
def test_every_language_has_the_same_words_none_empty_with_the_same_placeholders(name: str):
    words = LANGUAGES[name]
    assert set(words) ^ set(ENGLISH) == set()
    assert [key for key, text in words.items() if text.strip() == ""] == []
    assert [key for key in words if placeholders(words[key]) != placeholders(ENGLISH[key])] == []


@pytest.mark.parametrize("name", LANGUAGES)
@pytest.mark.parametrize("code", CODES)
def test_every_code_states_what_it_is_and_what_to_do(name: str, code: str):
    for part in ("what", "do"):
        assert len(LANGUAGES[name].get(f"hold.{code}.{part}", "")) > 3, f"{name}: hold.{code}.{part}"


@pytest.mark.parametrize("code", sorted(ALARMS.keys() - set(HoldReason)))
def test_english_states_of_an_alarm_that_is_no_hold_what_the_controller_states(code: str):
    assert ENGLISH[f"hold.{code}.what"] == ALARMS[code].text


@pytest.mark.parametrize("name", LANGUAGES)
@pytest.mark.parametrize("mover", Mover)
def test_every_mover_has_its_sentence_its_button_and_what_comes_first(name: str, mover: Mover):
    assert all(f"moved.{mover}.{part}" in LANGUAGES[name] for part in ("what", "confirm", "first"))


SEEN = {action for (_, path), action in audited().items() if path.startswith("/api/v1/sessions/{")}
"""The actions of a session, which stand among its events."""


@pytest.mark.parametrize("name", LANGUAGES)
def test_every_event_of_a_session_has_its_sentence(name: str):
    shown = {action for action in SEEN if action.split(".")[0] in {"session", "model"}}
    shown |= {f"model.{kind}" for kind in LearningEventKind}
    shown |= {f"to.{state}" for state in GateState if state is not GateState.DWELL}
    assert len(shown) > 20
    assert {one for one in shown if f"event.{one}" not in LANGUAGES[name]} == set()


def test_german_sentences_of_reasons_are_not_the_english_ones():
    parts = [key for key in ENGLISH if key.startswith("hold.")]
    assert [key for key in parts if LANGUAGES["de"][key] == ENGLISH[key]] == []


def test_every_sentence_of_the_controller_is_in_the_language_files_and_none_that_there_is_not():
    """``python -m tests.support.documents.sentences --write`` adds and removes them."""
    assert {key.removeprefix(PREFIX) for key in ENGLISH if key.startswith(PREFIX)} == templates()


def test_sentences_of_the_controller_are_german_but_for_those_that_are_alike():
    said = [key for key in ENGLISH if key.startswith(PREFIX) and len(key.split()) > 3]
    assert len(said) > 250
    assert [key for key in said if LANGUAGES["de"][key] == ENGLISH[key]] == []


def used() -> set[str]:
    """Return the keys that scripts and pages name."""
    texts = [file.read_text() for file in (*SCRIPTS, *PAGES)]
    patterns = (
        r"(?:tr|has)\(\"([\w.]+)\"",
        r"word\(\w+(?:\.\w+)?, \"([\w.]+)\"",
        r"data-(?:t|word)(?:-[a-z-]+)?=\"([\w.]+)\"",
    )
    return {key for text in texts for pattern in patterns for key in re.findall(pattern, text)} | set(
        re.findall(r"\"((?:sound|distance|lamp|line)\.[\w.]+)\"", "".join(texts))
    )


def test_no_word_is_used_that_there_is_not_and_none_is_there_unused():
    assert used() - set(ENGLISH) == set()
    unused = set(ENGLISH) - used()
    assert {key for key in unused if not key.startswith(tuple(MADE_OF)) and "unable." not in key} == {"language.name"}


class Visible(HTMLParser):
    """Collects what a document shows by itself."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []
        self.within: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in {"meta", "link", "input", "br"}:
            self.within.append(tag)
        self.found += [value or "" for name, value in attrs if name in {"title", "aria-label"}]

    def handle_endtag(self, tag: str) -> None:
        while self.within and self.within.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if not {"noscript", "title"} & set(self.within):
            self.found.append(data.strip())


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_a_document_has_no_words_of_its_own(page: Path):
    parser = Visible()
    parser.feed(page.read_text())
    shown = {text for text in parser.found if re.search(r"[A-Za-z]{2}", text)}
    assert {text for text in shown if text not in NAMES} == set()


SENTENCE = re.compile(r"[\"`](?:[A-Z][a-z]+ [a-z]+|[a-z]+ [a-z]+ [a-z]+)[^\"`]*[\"`]")
ALLOWED = {"a new model is ready", "comparing the stored model"}
"""Beginnings of the controller's notes, which a script compares."""


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_script_has_no_sentence_of_its_own(script: Path):
    code = re.sub(r"/\*.*?\*/|//[^\n]*", "", script.read_text(), flags=re.DOTALL)
    assert {found.strip('"`') for found in SENTENCE.findall(code)} - ALLOWED == set()


def test_a_third_language_needs_a_file_and_nothing_else(tmp_path: Path):
    folder = tmp_path / "lang"
    folder.mkdir()
    for name in ("en.json", "de.json", "fr.json", "notes.json", "pt-BR.json", "README.md"):
        (folder / name).write_text("{}")
    client = TestClient(Starlette(routes=[language_route(tmp_path)]))
    assert client.get(LANGUAGE_LIST).json() == {"languages": ["de", "en", "fr", "pt-BR"], "has_docs": False}
