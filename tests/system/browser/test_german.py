"""The page in German: in every state, none of its texts is the English one."""

import json
import re
from typing import Any

import pytest
from playwright.sync_api import Page, expect

from engine.core.sentences import Sentence, say
from tests.support.browser.arming import press_arm
from tests.support.browser.fake_service import DASHBOARD, FakeService, alarm, over, sample, spoken
from tests.support.browser.legibility import STATES
from tests.support.browser.tab import Tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

ENGLISH, GERMAN = (json.loads((DASHBOARD / "lang" / f"{name}.json").read_text()) for name in ("en", "de"))
TRANSLATED = {text.strip() for key, text in ENGLISH.items() if text != GERMAN[key]} - {
    text.strip() for text in GERMAN.values()
}
"""English texts that German words otherwise."""
DISARMED = sample(gate="disarmed", is_armed=False, hold_reason="disarmed", hold_text="Not armed", hold_detail="")
ALLOWED = {"English", "Deutsch", "End", "physicist", "admin"}
"""Names of languages, of a key, and of roles."""

# The texts of all elements and what they say to a pointer or a screen reader, also of hidden panels and templates.
READ = """() => {
  const found = [];
  const walk = (root) => {
    for (const element of root.querySelectorAll("*")) {
      for (const node of element.childNodes) if (node.nodeType === 3) found.push(node.textContent.trim());
      for (const name of ["title", "aria-label", "placeholder"]) found.push(element.getAttribute(name) ?? "");
      if (element.content) walk(element.content);
    }
  };
  walk(document.body);
  return [...new Set(found.filter((text) => text !== ""))];
}"""


def open_german(tab: Tab, kind: str) -> Page:
    tab.page.add_init_script("localStorage.setItem('tidegate.language', 'de')")
    return tab.open(kind)


def english_on(page: Page) -> set[str]:
    return (set(page.evaluate(READ)) & TRANSLATED) - ALLOWED


def test_the_table_of_english_texts_is_not_empty():
    assert len(TRANSLATED) > 500


@pytest.mark.parametrize("state", STATES)
def test_no_english_in_any_state(fake: FakeService, own_tab: Tab, state: str):
    fake.mode, fake.sample = "samples", STATES[state]
    fake.alarms = (alarm(1, "camera_moved", "medium", "The camera or the couch has moved"),)
    page = open_german(own_tab, state)
    expect(page.locator("#alarms li strong")).to_have_text(GERMAN["hold.camera_moved.what"])
    own_tab.draws(fake)
    assert english_on(page) == set()
    assert page.evaluate("document.documentElement.lang") == "de"


def test_no_english_without_a_session_and_in_the_form(fake: FakeService, own_tab: Tab):
    fake.mode, fake.sessions = "idle", []
    page = open_german(own_tab, "idle")
    expect(page.locator("#setup")).to_be_visible()
    own_tab.is_answered()
    assert english_on(page) == set()


def test_no_english_in_the_summary_of_a_session(fake: FakeService, own_tab: Tab):
    fake.mode, fake.sessions = "idle", [over()]
    page = open_german(own_tab, "idle")
    expect(page.locator("#report")).to_be_visible()
    assert english_on(page) == set()


def test_no_english_logged_out(fake: FakeService, own_tab: Tab):
    fake.person = None
    page = open_german(own_tab, "out")
    expect(page.locator("#access")).to_be_visible()
    assert english_on(page) == set()


def test_what_the_controller_says_with_values_is_german_too(fake: FakeService, own_tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    page = open_german(own_tab, "hold")
    expect(page.locator("#gate-detail")).to_have_text("4,10 mm liegt nicht in \N{MINUS SIGN}1 bis 3 mm")
    fake.sample = DISARMED
    own_tab.sees("disarmed")
    page.click("#do-arm")
    model = (
        "Modell 1 von 08:31 UTC; gelernt aus 312 Bildern, 4 Atemzügen; "
        "Atmung 9,0 mm, 99,1 % erklärt, Restfehler 0,41 mm"
    )
    expect(page.locator("#arming-items [data-code=model] dd")).to_have_text(model)
    expect(page.locator("#arming-items [data-code=head_direction] dd")).to_have_text(
        "oben im Bild: das Freischalten bestätigt es"
    )
    expect(page.locator("#arming-items [lang=en]")).to_have_count(0)


def test_a_refusal_of_the_controller_is_german_too(fake: FakeService, own_tab: Tab):
    refused = say("the newest frame is {age_ms:.0f} ms old: see to the camera", age_ms=412.0)
    fake.mode, fake.sample = "samples", DISARMED
    fake.problem = (409, {"code": "command_refused", "detail": refused, "sentences": spoken(refused)})
    page = open_german(own_tab, "disarmed")
    press_arm(page)
    expect(page.locator("#outcome")).to_contain_text("das neueste Bild ist 412 ms alt: nach der Kamera sehen")


def test_a_sentence_that_german_lacks_is_english_and_marked(fake: FakeService, own_tab: Tab):
    unknown = Sentence("5 things of a newer controller", "{n} things of a newer controller", {"n": "5"})
    fake.mode, fake.sample = "samples", sample(hold_detail=unknown)
    page = open_german(own_tab, "hold")
    expect(page.locator("#gate-detail [lang=en]")).to_have_text(str(unknown))


@pytest.mark.parametrize("code", ["a_new_reason", "", "<b>x</b>"])
def test_an_unknown_code_shows_the_controller_s_sentence_and_the_safest_advice(
    fake: FakeService, own_tab: Tab, code: str
):
    fake.mode, fake.sample = "samples", sample(hold_reason=code, hold_text="A sentence of a newer controller")
    page = open_german(own_tab, "hold")
    expect(page.locator("#gate-reason")).to_have_text("A sentence of a newer controller")
    expect(page.locator("#gate-do")).to_have_text(GERMAN["reason.unknown.do"])
    fake.sample = sample(hold_reason="a_new_reason", hold_text=None)
    expect(page.locator("#gate-reason")).to_have_text(re.compile("a_new_reason"))


def serve_german(tab: Tab, words: dict[str, Any] | None) -> None:
    body = None if words is None else json.dumps(words)
    tab.page.route("**/lang/de.json", lambda route: route.fulfill(status=404 if body is None else 200, body=body or ""))


def test_a_missing_word_is_shown_in_english_and_marked_never_empty(fake: FakeService, own_tab: Tab):
    serve_german(own_tab, {key: text for key, text in GERMAN.items() if key != "hold.outside_window.what"})
    fake.mode, fake.sample = "samples", sample()
    page = open_german(own_tab, "hold")
    expect(page.locator("#gate-reason")).to_have_text("[en] Outside the window")


def test_a_language_that_cannot_be_read_leaves_english(fake: FakeService, own_tab: Tab):
    serve_german(own_tab, None)
    fake.mode, fake.sample = "samples", sample()
    page = open_german(own_tab, "hold")
    expect(page.locator("#gate-reason")).to_have_text("Outside the window")


def test_the_page_asks_for_its_words_once_and_before_it_shows_a_state(fake: FakeService, own_tab: Tab):
    fake.mode, fake.sample = "samples", sample()
    page = open_german(own_tab, "hold")
    before = [url for url in own_tab.requests if "/lang/" in url]
    fake.sample = STATES["fault"]
    own_tab.sees("fault")
    page.wait_for_function("document.querySelector('#gate-word').textContent === 'Störung'")
    assert [url for url in own_tab.requests if "/lang/" in url] == before
    assert len(before) == 1 + len({"de", "en"})
