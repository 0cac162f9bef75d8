"""What a page has to offer a person who sees little, tabs, zooms or replaces the colours: findings, as sentences.

axe-core judges what it can (:func:`axe_findings`); what it does not check is measured on the page (``page_checks.js``).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Page

from tests.support.browser.tab import DRAWN

CHECKS = (Path(__file__).parent / "page_checks.js").read_text()
SIZES = ((1920, 1080), (1280, 800), (1024, 768), (768, 1024))
"""The sizes of screens that the page is made for [CSS px]."""
TAGS = ["wcag2a", "wcag2aa", "wcag21a", "wcag21aa", "wcag22aa", "best-practice"]
MOST_TABS = 150
# Without this, Tab goes on from what had the focus last.
FROM_THE_TOP = (
    "() => { document.body.tabIndex = -1; document.body.focus(); document.body.removeAttribute('tabindex'); }"
)


def axe_findings(page: Page, *rules: str) -> list[str]:
    """Return what axe-core finds against WCAG 2.2 AA and its best practices, or against some rules alone."""
    only = {"type": "rule", "values": list(rules)} if rules else {"type": "tag", "values": TAGS}
    options = {"resultTypes": ["violations"], "runOnly": only}
    response: dict[str, Any] = Axe().run(page, options=options).response
    return [
        f"{one['id']} ({one['impact']}): {', '.join(str(node['target'][0]) for node in one['nodes'][:6])}"
        for one in response["violations"]
    ]


def findings(page: Page, check: str, *given: float) -> list[str]:
    """Return the findings of a check of ``page_checks.js``."""
    page.evaluate(CHECKS)
    found: list[str] = page.evaluate("([check, given]) => pageChecks[check](...given)", [check, list(given)])
    return found


def layout_findings(page: Page) -> list[str]:
    """Return what is cut off, overlaps, lies outside the page, or hides the gate's state."""
    return [
        one
        for check in ("outside", "stateInView", "clipped", "covered", "overlapping")
        for one in findings(page, check)
    ]


def focus_findings(page: Page) -> tuple[int, list[str]]:
    """Press Tab through the whole page; return how many elements took the focus, and where it could not be seen."""
    page.evaluate(CHECKS)
    page.evaluate(FROM_THE_TOP)
    found, seen = [], []
    for _ in range(MOST_TABS):
        page.keyboard.press("Tab")
        now = page.evaluate("pageChecks.focused()")
        if now is None or now["key"] in seen:
            break
        seen.append(now["key"])
        if not now["ring"] or now["ringContrast"] < 3.0:
            found.append(f"{now['name']}: no mark of the focus ({now['ringContrast']:.1f}:1)")
        if now["seen"] < 4:
            found.append(f"{now['name']}: {4 - now['seen']} of its 4 corners are hidden")
    return len(seen), found


def settled(page: Page) -> None:
    """Wait until the page was drawn anew, after a change of its size or colours."""
    page.evaluate(DRAWN)


@dataclass(frozen=True)
class Tint:
    """Grey values of a part of the page, 0 to 255."""

    median: float
    spread: float


def tint(page: Page, selector: str) -> Tint:
    """Return the median grey of an element's picture, and the distance of its lightest from its darkest parts."""
    encoded = np.frombuffer(page.locator(selector).screenshot(), np.uint8)
    picture = cv2.imdecode(encoded, cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    low, middle, high = np.percentile(picture, (0.5, 50, 99.5))
    return Tint(median=float(middle), spread=float(high - low))
