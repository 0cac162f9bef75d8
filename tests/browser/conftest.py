"""One Chromium for these tests, a fresh tab and a fresh fake controller for each."""

from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
from playwright.sync_api import Browser, BrowserContext, Page, expect, sync_playwright
from starlette.types import ASGIApp, Receive, Scope, Send

from tests.browser.chromium import launch_chromium
from tests.browser.fake_service import FakeService, ServerThread

expect.set_options(timeout=8_000)


# Not for the whole run: while open, Playwright keeps an event loop in this thread, which other tests must not meet.
@pytest.fixture(scope="package")
def chromium() -> Iterator[Browser]:
    with sync_playwright() as playwright:
        browser = launch_chromium(playwright)
        yield browser
        browser.close()


# What Chromium itself reports of what tests provoke: refused calls and lost sockets, and their reading of canvases.
PROVOKED = ("Failed to load resource", "WebSocket connection", "willReadFrequently")


@dataclass
class Tab:
    """A tab on the page of a fake controller, and everything it complained about or asked for."""

    page: Page
    url: str
    complaints: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)

    def watch(self) -> None:
        self.page.on("pageerror", lambda error: self.complaints.append(f"exception: {error}"))
        self.page.on("console", lambda message: self._note(message.type, message.text))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.on("websocket", lambda websocket: self.requests.append(websocket.url))

    def _note(self, kind: str, text: str) -> None:
        if kind in {"error", "warning"} and not any(own in text for own in PROVOKED):
            self.complaints.append(f"{kind}: {text}")

    def open(self, kind: str) -> Page:
        """Load the page and wait until it shows this kind of state."""
        self.page.goto(self.url)
        self.sees(kind)
        return self.page

    def sees(self, kind: str) -> None:
        expect(self.page.locator("#gate")).to_have_attribute("data-kind", kind)


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
