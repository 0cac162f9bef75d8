"""A page whose time a test moves: nothing on it depends on the speed of the machine.

The page's clock stands still from before it is loaded. The fake service's clock is the same one, and it sends one
message a step. A step ends when the page has received that message and the answers to all its calls.
"""

from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

from playwright.sync_api import Page

from tests.support.browser.fake_service import FakeService
from tests.support.browser.tab import Tab

BEGAN = datetime(2026, 11, 20, tzinfo=UTC)
PAUSED = BEGAN + timedelta(days=1)
"""Far ahead: between the two calls the page's clock runs, and Playwright does not set it back."""
STEP_MS = 200


class SteppedPage:
    """A tab, and the time that it and its service share."""

    step_ms = STEP_MS

    def __init__(self, fake: FakeService, tab: Tab) -> None:
        self.fake, self.tab = fake, tab
        self.page: Page = tab.page
        self._now_s = PAUSED.timestamp()
        fake.is_stepped, fake.is_relaxed, fake.clock = True, False, lambda: self._now_s
        self.page.clock.install(time=BEGAN)
        self.page.clock.pause_at(PAUSED)

    def open(self, message: dict[str, Any] | None, kind: str | None = None) -> Page:
        """Load the page and wait until it shows the message, or another kind of state."""
        if message is not None:
            self.fake.mode, self.fake.sample = "samples", message
        self.page.goto(self.tab.url)
        wanted = kind or self.fake.sample["gate"]
        self.advance_until(lambda: self.kind == wanted)
        return self.page

    def open_settled(self, message: dict[str, Any]) -> Page:
        """Load the page and wait until its buttons accept clicks."""
        page = self.open(message)
        self.advance_until(lambda: page.locator("[aria-disabled]").count() == 0)
        return page

    @property
    def kind(self) -> str | None:
        """The kind of state that the gate's panel shows."""
        return self.page.get_attribute("#gate", "data-kind")

    def advance(self, milliseconds: int) -> None:
        """Let this time pass, in steps."""
        self._exchange()
        for _ in range(0, milliseconds, self.step_ms):
            self._step()

    def leap(self, milliseconds: int) -> None:
        """Let this time pass at once, without a message meanwhile: what the page shows is old then."""
        self._exchange()
        self.page.clock.fast_forward(milliseconds)
        self._now_s += milliseconds / 1000
        self._exchange()

    def advance_until(self, is_so: Callable[[], object], within_ms: int = 10_000) -> None:
        """Let time pass until that is so; fail after this time of the page's clock."""
        if is_so():
            return
        self._exchange()
        for _ in range(0, within_ms, self.step_ms):
            self._step()
            if is_so():
                return
        assert is_so(), f"did not happen within {within_ms} ms of the page's clock; the gate shows {self.kind}"

    def shows(self, message: dict[str, Any]) -> None:
        """Let the service send this from now on, and wait until the page shows its state."""
        self.fake.mode, self.fake.sample = "samples", message
        self.advance(self.step_ms)
        self.advance_until(lambda: self.kind == message["gate"])

    def _step(self) -> None:
        # The page goes first: a message of its future, to a socket opened meanwhile, would make all others look late.
        self.page.clock.run_for(self.step_ms)
        self._now_s += self.step_ms / 1000
        self._exchange()

    def _exchange(self) -> None:
        """Let the service send its next message, and wait until nothing is on its way to the page or from it."""
        self.fake.turn()
        self.tab.await_that(self._is_quiet, "what is on its way to the page or from it does not arrive")

    def _is_quiet(self) -> bool:
        sockets = self.fake.open_sockets
        if sockets and self.fake.turns_done < self.fake.turns:
            return False
        seen = self.page.evaluate("traffic")
        is_received = not sockets or seen["sequence"] >= self.fake.sent
        return seen["inFlight"] == 0 and seen["openSockets"] == sockets == self.fake.open_sockets and is_received
