"""One Chromium for these tests, a fresh tab and a fresh fake controller for each."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, BrowserContext, Playwright, expect, sync_playwright

from service.web.app import PATIENT
from tests.support.browser.chromium import launch_chromium
from tests.support.browser.fake_coach import FakeCoach, FakeConsole, SteppedScreen
from tests.support.browser.fake_service import FakeService, ServerThread
from tests.support.browser.served_tab import Door, opened_tab
from tests.support.browser.stepped_page import SteppedPage
from tests.support.browser.tab import Tab

PATIENCE_MS = 60_000
expect.set_options(timeout=PATIENCE_MS)


# Not for the whole run: while open, Playwright keeps an event loop in this thread, which other tests must not meet.
@pytest.fixture(scope="package")
def playwright() -> Iterator[Playwright]:
    with sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="package")
def chromium(playwright: Playwright) -> Iterator[Browser]:
    browser = launch_chromium(playwright)
    yield browser
    browser.close()


@pytest.fixture
def fake() -> FakeService:
    return FakeService()


def make_context(chromium: Browser) -> BrowserContext:
    context = chromium.new_context(viewport={"width": 1280, "height": 800}, color_scheme="dark")
    context.set_default_timeout(PATIENCE_MS)
    return context


@pytest.fixture
def context(chromium: Browser) -> Iterator[BrowserContext]:
    """A context of the test's own, with cookies and a clock of its own."""
    context = make_context(chromium)
    yield context
    context.close()


@pytest.fixture(scope="package")
def shared_context(chromium: Browser) -> Iterator[BrowserContext]:
    """One context for the tabs of the fake controller: it sets no cookies, and the page's files are loaded once."""
    context = make_context(chromium)
    yield context
    context.close()


@pytest.fixture(scope="package")
def door() -> Iterator[tuple[Door, str]]:
    door = Door()
    with ServerThread(door) as server:
        yield door, server.url


@pytest.fixture
def tab(fake: FakeService, shared_context: BrowserContext, door: tuple[Door, str]) -> Iterator[Tab]:
    """A tab on a page that finds nothing old because the machine is slow, and that keeps no settings."""
    with opened_tab(fake, shared_context, door) as tab:
        yield tab
        if not tab.page.is_closed():  # the context is of other tests, too
            tab.page.evaluate("location.protocol === 'http:' && localStorage.clear()")


@pytest.fixture
def own_tab(fake: FakeService, context: BrowserContext, door: tuple[Door, str]) -> Iterator[Tab]:
    """A tab like `tab`, whose browser keeps settings for this test only: a language, a volume."""
    with opened_tab(fake, context, door) as tab:
        yield tab


@pytest.fixture
def stepped(fake: FakeService, context: BrowserContext, door: tuple[Door, str]) -> Iterator[SteppedPage]:
    """A page as it is, whose time the test moves."""
    with opened_tab(fake, context, door) as tab:
        yield SteppedPage(fake, tab)


@pytest.fixture
def coach() -> FakeCoach:
    """A fake controller of a patient's screen."""
    return FakeCoach()


@pytest.fixture
def patient_tab(coach: FakeCoach, context: BrowserContext, door: tuple[Door, str]) -> Iterator[Tab]:
    """A tab for the patient's page."""
    with opened_tab(coach, context, door) as tab:
        tab.url += f"{PATIENT}/"
        yield tab


@pytest.fixture
def screen(coach: FakeCoach, patient_tab: Tab) -> SteppedScreen:
    """The patient's page as it is, whose time the test moves."""
    return SteppedScreen(coach, patient_tab)


@pytest.fixture
def console() -> FakeConsole:
    """A fake controller of a console with a patient screen."""
    return FakeConsole()


@pytest.fixture
def console_tab(console: FakeConsole, context: BrowserContext, door: tuple[Door, str]) -> Iterator[Tab]:
    """A tab for the console's page."""
    with opened_tab(console, context, door) as tab:
        yield tab
