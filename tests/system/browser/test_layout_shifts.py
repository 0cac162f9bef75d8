"""Nothing moves: frames that come late, in every state, at every size, shift nothing; every language is at one."""

from itertools import cycle
from typing import Any

import pytest

from tests.support.browser.accessibility import SIZES
from tests.support.browser.fake_service import FakeService
from tests.support.browser.page_states import BEAM_ON, DISARMED, FAULT, LOST, OLD_MS, SETTLING, TRAINING
from tests.support.browser.tab import Tab
from tests.support.repository import ROOT

pytestmark = [pytest.mark.browser, pytest.mark.verification]

LANGUAGES = [path.stem for path in sorted((ROOT / "service/web/dashboard/lang").glob("??.json"))]
STATES = {
    "beam_on": BEAM_ON,
    "hold": LOST,
    "disarmed": DISARMED,
    "training": TRAINING,
    "settling": SETTLING,
    "fault": FAULT,
}
WATCH = """() => {
  window.shifts = [];
  const name = ({ node }) => node === null ? 'gone' : node.id || node.parentElement?.id || node.nodeName;
  new PerformanceObserver((seen) => seen.getEntries().forEach((one) =>
    shifts.push([one.value, one.sources.map(name)]))).observe({ type: 'layout-shift' });
}"""


def hands(tab: Tab) -> list[Any]:
    """Where Hold and Disarm are."""
    return [tab.page.locator(name).bounding_box() for name in ("#do-hold", "#do-disarm")]


@pytest.mark.parametrize(("size", "language"), [*zip(SIZES, cycle(LANGUAGES), strict=False)])
def test_late_frames_shift_nothing(fake: FakeService, own_tab: Tab, size: tuple[int, int], language: str):
    tab = own_tab
    tab.page.set_viewport_size({"width": size[0], "height": size[1]})
    tab.page.add_init_script(f"localStorage.setItem('tidegate.language', '{language}')")
    fake.mode, fake.sample = "samples", DISARMED
    tab.open("disarmed")
    tab.page.wait_for_selector("#do-coach")  # the last that comes into the bar of a page that opens
    first = hands(tab)
    for state, message in STATES.items():
        fake.sample = message
        tab.sees(message["gate"])
        tab.page.wait_for_timeout(300)
        tab.page.evaluate(WATCH)
        for _ in range(3):
            fake.sample = message | {"age_ms": OLD_MS}
            tab.sees("fault" if message["gate"] == "fault" else "stale")
            assert hands(tab) == first, f"{state}, late"
            fake.sample = message
            tab.sees(message["gate"])
            assert hands(tab) == first, state
        tab.page.wait_for_timeout(100)
        assert tab.page.evaluate("shifts") == [], state
