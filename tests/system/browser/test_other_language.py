"""A third language is one file: with it, no letter on the page is of another, but for names.

Texts of the service that no language file has (notes of devices and files) are marked with ``lang="en"``.
"""

import json
import re

import pytest
from playwright.sync_api import BrowserContext, Page, Route

from tests.support.browser.fake_service import DASHBOARD
from tests.support.browser.page_states import STATES, make_fake
from tests.support.browser.served_tab import Door, opened_tab

pytestmark = [pytest.mark.browser, pytest.mark.verification]

ENGLISH = json.loads((DASHBOARD / "lang" / "en.json").read_text())
CYRILLIC = {ord(letter): chr(0x0430 + number) for number, letter in enumerate("abcdefghijklmnopqrstuvwxyz")}
CYRILLIC |= {ord(letter): chr(0x0410 + number) for number, letter in enumerate("ABCDEFGHIJKLMNOPQRSTUVWXYZ")}
WORDS = re.compile(r"[A-Za-z]{3,}")
SAID = re.compile("\u2068[^\u2069]*\u2069")
PLACEHOLDER = re.compile(r"(\{\w+\})")
NAMES = {
    *("Tidegate", "Linac", "Therapist", "Physicist", "Nurse", "Grace", "PLAN", "LUNG", "GATED", "LIVER", "BREAST"),
    *("DIBH", "RIGHT", "Xtion", "UTC", "Nov", "min", "demo", "recording", "oni", "planning"),
    *("Record", "and", "verify", "plan", "abcdef", "PDF", "HTML", "CSV", "Arrow", "Parquet"),
}
"""Names of people, patients, plans, devices, files, roles' codes, keys of the keyboard, languages."""

READ = """() => {
  const found = [];
  for (const element of document.body.querySelectorAll("*")) {
    const isElsewhere = element.closest("[lang=en], noscript, template, kbd, svg, script") !== null;
    if (isElsewhere || !element.checkVisibility({ visibilityProperty: true })) continue;
    for (const node of element.childNodes) if (node.nodeType === 3) found.push(node.textContent.trim());
    for (const name of ["title", "aria-label", "placeholder"]) found.push(element.getAttribute(name) ?? "");
  }
  return [...new Set(found.filter((text) => text !== ""))];
}"""


def other(text: str) -> str:
    """Return the text with each of its letters replaced, its placeholders kept."""
    return "".join(
        part if PLACEHOLDER.fullmatch(part) else part.translate(CYRILLIC) for part in PLACEHOLDER.split(text)
    )


def serve_other(page: Page) -> None:
    words = {key: other(text) for key, text in ENGLISH.items()}
    page.route("**/lang/index.json", lambda route: fulfil(route, {"languages": ["en", "xx"]}))
    page.route("**/lang/xx.json", lambda route: fulfil(route, words))
    page.add_init_script("localStorage.setItem('tidegate.language', 'xx')")


def fulfil(route: Route, answer: object) -> None:
    route.fulfill(json=answer)


@pytest.mark.parametrize("name", STATES)
def test_no_word_on_the_page_is_of_another_language(shared_context: BrowserContext, door: tuple[Door, str], name: str):
    state, fake = STATES[name], make_fake()
    state.apply(fake)
    with opened_tab(fake, shared_context, door) as tab:
        serve_other(tab.page)
        state.open(tab.page, tab.url)
        texts = tab.page.evaluate(READ)
    found = {text for text in texts if set(WORDS.findall(SAID.sub("", text))) - NAMES}
    assert found == set()
