"""One server for many tests, and a tab on the fake controller that stands behind it."""

import contextlib
from collections.abc import Iterator

from playwright.sync_api import BrowserContext
from starlette.types import ASGIApp, Receive, Scope, Send

from tests.support.browser.fake_service import FakeService
from tests.support.browser.tab import Tab


class Door:
    """One server for all these tests; behind it stands the fake controller of the test that runs."""

    def __init__(self) -> None:
        self.app: ASGIApp = FakeService().app()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        await self.app(scope, receive, send)


@contextlib.contextmanager
def opened_tab(fake: FakeService, context: BrowserContext, door: tuple[Door, str]) -> Iterator[Tab]:
    door[0].app = fake.app()
    tab = Tab(page=context.new_page(), url=door[1])
    tab.watch()
    yield tab
    tab.page.close()
    fake.is_up = False
    assert tab.complaints == []
