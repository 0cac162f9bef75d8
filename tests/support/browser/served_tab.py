"""One server for many tests, and a tab on the fake controller that stands behind it."""

import contextlib
import itertools
from collections.abc import Iterator

from playwright.sync_api import BrowserContext
from starlette.responses import Response
from starlette.types import ASGIApp, Receive, Scope, Send

from tests.support.browser.fake_service import FakeService
from tests.support.browser.tab import Tab

TAB = b"x-tab"


class Door:
    """One server for all these tests; behind it stands the fake controller of the test that runs.

    A call of a tab that is closed already may still be on its way: it is answered here, and reaches no later test.
    """

    def __init__(self) -> None:
        self.app: ASGIApp = FakeService().app()
        self._tabs = itertools.count()
        self._closed: set[bytes] = set()

    def opened(self, app: ASGIApp) -> str:
        """Put another fake controller behind the server; return the number that its tab's calls carry."""
        self.app = app
        return str(next(self._tabs))

    def closed(self, number: str) -> None:
        """Answer the remaining calls of this tab here."""
        self._closed.add(number.encode())

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        is_late = dict(scope.get("headers", ())).get(TAB) in self._closed
        await (GONE if is_late else self.app)(scope, receive, send)


GONE = Response("the tab is closed", status_code=503)


@contextlib.contextmanager
def opened_tab(fake: FakeService, context: BrowserContext, door: tuple[Door, str]) -> Iterator[Tab]:
    page = context.new_page()
    number = door[0].opened(fake.app())
    page.set_extra_http_headers({TAB.decode(): number})
    tab = Tab(page=page, url=door[1])
    tab.watch()
    try:
        yield tab
    finally:  # a page that is left open draws on, and every later test is slow
        tab.page.close()
        door[0].closed(number)
        fake.is_up = False
    assert tab.complaints == []
