"""One browser tab on the page: what it shows, and the errors that it logs."""

from dataclasses import dataclass, field

from playwright.sync_api import Page, expect

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
