"""Pictures of the patient's screen in each state, and of the console's panel, for people to look at.

Run: ``python -m tests.system.browser.patient_screenshots OUT``.
"""

import sys
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, sync_playwright

from service.web.app import PATIENT
from tests.support.browser.chromium import launch_chromium
from tests.support.browser.fake_coach import SCREEN, FakeCoach, FakeConsole, guide
from tests.support.browser.fake_service import ServerThread, sample

SIZE = {"width": 1280, "height": 800}
HELD = {"instruction": "hold", "level": 0.71}
STATES: dict[str, dict[str, Any]] = {
    "breathe-in": guide(),
    "hold-settling": guide(**HELD),
    "hold-countdown": guide(**HELD, countdown_s=12.3),
    "breathe-out": guide(instruction="breathe_out", level=0.7),
    "breathe-out-beyond": guide(instruction="breathe_out", level=0.93),
    "rest": guide(instruction="breathe_freely", level=0.25),
    "practice-de": guide(instruction="breathe_in", is_practice=True, language="de"),
    "no-band": guide(instruction="breathe_freely", band=None),
}
CURVES = {
    "curve-breathe-freely": guide(display="curve", instruction="breathe_freely", band={"lower": 0.1, "upper": 0.4}),
    "curve-hold-practice": guide(display="curve", **HELD, countdown_s=8.0, is_practice=True, language="de"),
}


def take_patient(browser: Browser, out: Path) -> None:
    """Take the patient's page in every state, with forced colours, on a tall tablet, and before the pairing."""
    coach = FakeCoach()
    coach.is_relaxed = False
    with ServerThread(coach.app()) as server:
        page = browser.new_page(viewport=SIZE)
        page.goto(f"{server.url}{PATIENT}/")
        for name, message in STATES.items():
            _take(page, coach, out / f"patient-{name}.png", message)
        page.emulate_media(forced_colors="active")
        _take(page, coach, out / "patient-forced-colours.png", STATES["hold-countdown"])
        page.emulate_media(forced_colors="none")
        coach.is_breathing = True
        for name, message in CURVES.items():
            _take(page, coach, out / f"patient-{name}.png", message, settle_ms=6_000)
        coach.is_breathing = False
        page.set_viewport_size({"width": 800, "height": 1280})
        _take(page, coach, out / "patient-tall.png", STATES["hold-countdown"])
        page.set_viewport_size(SIZE)
        for mode in ("wait", "silent"):
            coach.mode = mode
            page.wait_for_timeout(800)
            page.screenshot(path=out / f"patient-{mode}.png")
        coach.is_paired, coach.person = False, None
        page.locator("#pair").wait_for()
        page.fill("#pair-code", "12345")
        page.keyboard.press("Enter")
        page.wait_for_timeout(400)
        page.screenshot(path=out / "patient-code.png")
        coach.is_up = False


def take_console(browser: Browser, out: Path) -> None:
    """Take the console's panel: without a screen, with a code, and with a screen in practice."""
    console = FakeConsole()
    console.mode, console.sample = "samples", sample(gate="disarmed", is_armed=False)
    with ServerThread(console.app()) as server:
        page = browser.new_page(viewport=SIZE)
        page.goto(server.url)
        page.locator("#gate[data-kind=disarmed]").wait_for()
        page.click("#do-coach")
        page.get_by_role("button", name="Show pairing code").click()
        page.wait_for_timeout(1_500)
        page.screenshot(path=out / "console-code.png")
        console.screens, console.guide = [SCREEN], guide(**HELD, countdown_s=12.3, is_practice=True)
        console.coaching |= {"is_practice": True}
        page.wait_for_timeout(3_000)
        page.screenshot(path=out / "console-practice.png")
        page.set_viewport_size({"width": 1024, "height": 768})
        page.wait_for_timeout(500)
        page.screenshot(path=out / "console-tablet.png")
        console.is_up = False


def _take(page: Page, coach: FakeCoach, path: Path, message: dict[str, Any], *, settle_ms: int = 600) -> None:
    coach.guide = message
    page.wait_for_timeout(settle_ms)
    page.screenshot(path=path)


def main(out: Path) -> None:
    """Write the pictures."""
    out.mkdir(parents=True, exist_ok=True)
    with sync_playwright() as playwright:
        browser = launch_chromium(playwright, is_shell=False)
        take_patient(browser, out)
        take_console(browser, out)
        browser.close()


if __name__ == "__main__":
    main(Path(sys.argv[1]))
