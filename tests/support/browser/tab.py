"""One browser tab on the page: what it shows, and the errors that it logs."""

from collections.abc import Callable
from dataclasses import dataclass, field

from playwright.sync_api import Page, expect

from tests.support.browser.fake_service import FakeService
from tests.support.waiting import eventually

# What Chromium reports of what tests provoke: refused calls and lost sockets, its reading of canvases, a hung page, and
# WebGL without a graphics processor.
PROVOKED = (
    *("Failed to load resource", "WebSocket connection", "willReadFrequently", "Synchronous XMLHttpRequest"),
    "GL Driver Message",
)

# Notes what the page has received of its service, and what it still waits for.
NOTE_TRAFFIC = """(() => {
  const traffic = { sequence: 0, inFlight: 0, openSockets: 0 };
  window.traffic = traffic;
  const fetchNow = window.fetch.bind(window);
  window.fetch = async (...given) => {
    traffic.inFlight += 1;
    try {
      const response = await fetchNow(...given);
      await response.clone().arrayBuffer();
      return response;
    } finally {
      traffic.inFlight -= 1;
    }
  };
  window.WebSocket = class extends WebSocket {
    constructor(...given) {
      super(...given);
      let isOpen = false;
      traffic.inFlight += 1;
      this.addEventListener("open", () => { isOpen = true; traffic.inFlight -= 1; traffic.openSockets += 1; });
      this.addEventListener("close", () => { if (isOpen) traffic.openSockets -= 1; else traffic.inFlight -= 1; });
      this.addEventListener("message", (event) => {
        const found = /"sequence": ?(\\d+)/.exec(event.data);
        if (found !== null) traffic.sequence = Number(found[1]);
      });
    }
  };
})()"""

# Resolves once all panels were drawn anew: they are drawn in animation frames, every 120 ms.
DRAWN = """() => new Promise((resolve) => {
  const endMs = performance.now() + 250;
  let after = 2;
  const look = () => {
    if (performance.now() > endMs) after -= 1;
    if (after < 0) resolve();
    else requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
})"""


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
        self.page.add_init_script(NOTE_TRAFFIC)

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

    def await_that(self, is_so: Callable[[], object], detail: str = "that did not happen in time") -> None:
        """Wait while the tab goes on."""
        eventually(lambda: is_so() or self.page.wait_for_timeout(3), detail=lambda: detail)

    def is_answered(self) -> None:
        """Wait until no call of the tab is under way."""
        self.await_that(lambda: self.page.evaluate("traffic.inFlight") == 0, "a call is not answered")

    def open_setup(self) -> None:
        """Open the set-up, unless the page did by itself on its first look at the sessions."""
        self.is_answered()
        if self.page.locator("#setup").is_hidden():
            self.page.click("#do-setup")

    def draws(self, fake: FakeService, messages: int = 3) -> None:
        """Wait until the tab has received so many newer messages and drawn them."""
        wanted = fake.sent + messages
        self.await_that(lambda: self.page.evaluate("traffic.sequence") >= wanted, "no messages come")
        self.page.evaluate(DRAWN)
