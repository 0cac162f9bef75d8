"""One Chromium for these tests, a fresh tab and a fresh fake controller for each."""

from collections.abc import Iterator

import pytest
from playwright.sync_api import Browser, BrowserContext, expect, sync_playwright
from starlette.types import ASGIApp, Receive, Scope, Send

from tests.support.browser.chromium import launch_chromium
from tests.support.browser.fake_service import FakeService, ServerThread
from tests.support.browser.tab import Tab

expect.set_options(timeout=8_000)


# Not for the whole run: while open, Playwright keeps an event loop in this thread, which other tests must not meet.
@pytest.fixture(scope="package")
def chromium() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = launch_chromium(playwright)
        yield browser
        browser.close()


@pytest.fixture
def fake() -> FakeService:
    return FakeService()


@pytest.fixture
def context(chromium: Browser) -> Iterator[BrowserContext]:
    context = chromium.new_context(viewport={"width": 1280, "height": 800})
    yield context
    context.close()


class Door:
    """One server for all these tests; behind it stands the fake controller of the test that runs."""

    def __init__(self) -> None:
        self.app: ASGIApp = FakeService().app()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self.app(scope, receive, send)


@pytest.fixture(scope="package")
def door() -> Iterator[tuple[Door, str]]:
    door = Door()
    with ServerThread(door) as server:
        yield door, server.url


@pytest.fixture
def tab(fake: FakeService, context: BrowserContext, door: tuple[Door, str]) -> Iterator[Tab]:
    door[0].app = fake.app()
    tab = Tab(page=context.new_page(), url=door[1])
    tab.watch()
    yield tab
    tab.page.close()
    fake.is_up = False
    assert tab.complaints == []
