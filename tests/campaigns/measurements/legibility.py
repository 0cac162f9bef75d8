"""How large and how distinct the distance view is, measured in the page.

``python -m tests.campaigns.measurements.legibility`` opens ``?view=distance`` in Debian's Chromium at 1920 x 1080 in
every language and state. It prints for each text its size, the angle under which its capitals are seen at 3 m on
24 inch, and its contrast; then how BEAM ON and FAULT differ, for normal and colour-blind eyes and in grey.
``--pictures DIR`` writes a picture of every state, in colour and in grey.
"""

from pathlib import Path
from typing import Annotated

import cv2
import typer
from playwright.sync_api import Page, sync_playwright

from service.web.languages import language_names
from tests.support.browser import legibility as seen
from tests.support.browser.chromium import launch_chromium
from tests.support.browser.fake_service import DASHBOARD, FakeService, ServerThread

SETTLE_MS = 2_500
FILLED = ("beam_on", "fault")
OLD_MS = 100_000.0
"""More than any limit of the page, also of one with relaxed times."""


def main(
    *, pictures: Annotated[Path | None, typer.Option(help="Folder for a picture of every state, also in grey.")] = None
) -> None:
    """Print the tables."""
    rows: list[seen.SeenText] = []
    grounds: dict[str, list[int]] = {}
    fake = FakeService()
    with sync_playwright() as playwright, ServerThread(fake.app()) as server:
        browser = launch_chromium(playwright)
        for language in language_names(DASHBOARD):
            width, height = seen.SIZE_PX
            page = browser.new_page(viewport={"width": width, "height": height}, locale=language)
            page.goto(f"{server.url}/?view=distance")
            for state in [*seen.STATES, "stale", "idle"]:
                _show(fake, page, state)
                rows += seen.texts_of(page, f"{language} {state}")
                if state in FILLED:
                    grounds[state] = seen.ground_of(page)
                if pictures is not None:
                    _picture(page, pictures, f"distance-{language}-{state}")
            page.close()
        fake.is_up = False
    _print_texts(rows)
    _print_colours(grounds)


def _show(fake: FakeService, page: Page, state: str) -> None:
    if state in seen.STATES:
        fake.mode, fake.sample = "samples", seen.STATES[state]
        fake.sessions[0]["gate"] = {"state": state, "hold_reason": fake.sample["hold_reason"]} | {
            "state_since": "2026-11-20T08:00:00Z"
        }
        fake.sessions[0]["summary"] = {"holds": []}
    elif state == "stale":
        fake.mode, fake.sample = "samples", seen.STATES["hold"] | {"age_ms": OLD_MS}
    else:
        fake.mode = "idle"
    page.wait_for_selector(f"#gate[data-kind={state}]")
    page.wait_for_timeout(SETTLE_MS)


def _picture(page: Page, folder: Path, name: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    page.screenshot(path=folder / f"{name}.png")
    grey = cv2.imread(str(folder / f"{name}.png"), cv2.IMREAD_GRAYSCALE)
    assert grey is not None
    cv2.imwrite(str(folder / f"{name}-grey.png"), grey)


def _print_texts(rows: list[seen.SeenText]) -> None:
    typer.echo("| state | text | font, px | capital, px | arcmin at 3 m | contrast | inside the panel |")
    typer.echo("|---" * 7 + "|")
    for row in rows:
        size = f"{row.font_px:.1f} | {row.capital_px:.1f} | {row.arcmin:.1f} | {row.contrast:.1f}"
        typer.echo(f"| {row.state} | {row.name} | {size} | {'yes' if row.is_inside else 'NO'} |")


def _print_colours(grounds: dict[str, list[int]]) -> None:
    typer.echo("\n| vision | luminance, BEAM ON against FAULT | colour difference |\n|---|---|---|")
    on, fault = grounds["beam_on"], grounds["fault"]
    for vision in seen.BLINDNESS:
        ratio = seen.ratio(seen.as_seen(on, vision), seen.as_seen(fault, vision))
        typer.echo(f"| {vision} | {ratio:.2f}:1 | {seen.difference(on, fault, vision):.0f} |")


if __name__ == "__main__":
    typer.run(main)
