"""Pictures of every state of the page, for people to look at.

Run: ``python -m tests.system.browser.page_pictures OUT [STATE ...]`` draws each state at the four sizes, in the bright
theme, in grey and in forced colours; ``--documentation`` draws those of docs/pictures instead.

Not a test: what is wrong with a picture is for eyes. Each shows the page some breaths after its state began.
"""

import sys
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from tests.support.browser.accessibility import SIZES, settled
from tests.support.browser.chromium import launch_chromium
from tests.support.browser.fake_service import ServerThread
from tests.support.browser.page_states import STATES, make_fake
from tests.support.browser.served_tab import Door
from tests.support.repository import ROOT

SETTLE_MS = 5_000
PERIOD_S = 1.0 / 120.0
"""Four times as fast as a camera: the trace is full when the picture is taken."""
BREATHING_GATES = {"beam-on": "beam_on", "hold": "hold"}
"""States in which the gate follows the breath: the picture waits for them."""
DOCUMENTED = {
    "alarms": "alarms",
    "beam-line-fault": "fault",
    "beam-on": "beam-on",
    "breath-hold": "breath-settling",
    "hold": "hold",
    "log-in": "logged-out",
    "operator-hold": "operator-hold",
}


def draw(page: Page, door: Door, url: str, name: str) -> None:
    """Bring the page into a state, and let the patient breathe."""
    state, fake = STATES[name], make_fake()
    state.apply(fake)
    fake.period_s, fake.is_breathing = PERIOD_S, state.message is not None and state.message["regions_mm"] is not None
    fake.keeps_gate = name not in BREATHING_GATES
    fake.is_breathing &= not name.startswith("breath-")
    door.app = fake.app()
    state.open(page, url)
    page.wait_for_timeout(SETTLE_MS)
    _await_gate(page, name)


def _await_gate(page: Page, name: str) -> None:
    """Wait for the beginning of the state, where the gate follows the breath."""
    kind = BREATHING_GATES.get(name)
    if kind is None:
        return
    page.locator(f"#gate:not([data-kind={kind}])").wait_for()
    page.locator(f"#gate[data-kind={kind}]").wait_for()


def picture(page: Page, name: str, path: Path, size: tuple[int, int]) -> None:
    """Take a picture of this size."""
    page.set_viewport_size({"width": size[0], "height": size[1]})
    settled(page)
    _await_gate(page, name)
    page.screenshot(path=path)


def take(page: Page, out: Path, name: str) -> None:
    """Take the pictures of a state: at each size, in grey, and in forced colours."""
    for size in SIZES:
        picture(page, name, out / f"{name}-{size[0]}x{size[1]}.png", size)
    page.evaluate("document.documentElement.dataset.theme = 'bright'")
    picture(page, name, out / f"{name}-bright.png", SIZES[1])
    page.evaluate("document.documentElement.dataset.theme = 'dark'")
    session = page.context.new_cdp_session(page)
    session.send("Emulation.setEmulatedVisionDeficiency", {"type": "achromatopsia"})
    picture(page, name, out / f"{name}-grey.png", SIZES[1])
    session.send("Emulation.setEmulatedVisionDeficiency", {"type": "none"})
    page.emulate_media(forced_colors="active")
    picture(page, name, out / f"{name}-forced.png", SIZES[1])


def main(arguments: list[str]) -> None:
    """Write the pictures."""
    is_documentation = arguments == ["--documentation"]
    if not is_documentation and (not arguments or arguments[0].startswith("-")):
        sys.exit(__doc__)
    out = ROOT / "docs" / "pictures" if is_documentation else Path(arguments[0])
    out.mkdir(parents=True, exist_ok=True)
    door = Door()
    with ServerThread(door) as server, sync_playwright() as playwright:
        browser = launch_chromium(playwright)
        for name in sorted(DOCUMENTED.values()) if is_documentation else arguments[1:] or STATES:
            page = browser.new_page(viewport={"width": SIZES[1][0], "height": SIZES[1][1]}, color_scheme="dark")
            draw(page, door, server.url, name)
            if is_documentation:
                title = next(title for title, state in DOCUMENTED.items() if state == name)
                picture(page, name, out / f"page-{title}.png", SIZES[1])
            else:
                take(page, out, name)
            page.close()
        browser.close()


if __name__ == "__main__":
    main(sys.argv[1:])
