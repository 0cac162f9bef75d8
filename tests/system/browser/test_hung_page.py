"""A page whose script hangs does not stay green: the cover over the gate closes in the browser's own compositor."""

import base64
import time

import cv2
import numpy as np
import pytest

from tests.support.browser.fake_service import FakeService, sample
from tests.support.browser.tab import Tab

pytestmark = pytest.mark.browser

HANG = "setTimeout(() => { const end = performance.now() + 2500; while (performance.now() < end); }, 0)"


class Screen:
    """What a person sees, taken from outside of the page: it goes on while the page's script stands still."""

    def __init__(self, tab: Tab) -> None:
        self._page = tab.page
        self._session = tab.page.context.new_cdp_session(tab.page)
        self._unanswered: list[int] = []
        self._newest = b""
        self._session.on("Page.screencastFrame", self._keep)
        self._session.send("Page.startScreencast", {"format": "png", "everyNthFrame": 1})

    def _keep(self, event: dict[str, object]) -> None:
        self._newest = base64.b64decode(str(event["data"]))
        self._unanswered.append(int(str(event["sessionId"])))

    def watch(self, seconds: float) -> None:
        deadline_s = time.monotonic() + seconds
        while time.monotonic() < deadline_s:
            while self._unanswered:
                self._session.send("Page.screencastFrameAck", {"sessionId": self._unanswered.pop()})
            self._page.wait_for_timeout(20)

    def green_share(self) -> float:
        """Return the share of the gate panel (the upper left of the screen) that is green."""
        picture = cv2.imdecode(np.frombuffer(self._newest, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        height, width = picture.shape[:2]
        gate = picture[int(0.08 * height) : int(0.47 * height), int(0.01 * width) : int(0.305 * width)].astype(int)
        blue, green, red = gate[..., 0], gate[..., 1], gate[..., 2]
        return float(np.mean((green > red + 30) & (green > blue + 20)))


def test_the_cover_closes_over_a_green_gate_when_the_script_hangs(fake: FakeService, tab: Tab):
    fake.mode, fake.sample = "samples", sample(gate="beam_on", hold_reason=None, hold_text=None, line_on=True)
    tab.open("beam_on")
    screen = Screen(tab)
    screen.watch(0.6)
    assert screen.green_share() > 0.7
    tab.page.evaluate(HANG)
    screen.watch(1.8)
    assert screen.green_share() < 0.01
    screen.watch(1.6)
    tab.sees("beam_on")
    screen.watch(0.3)
    assert screen.green_share() > 0.7, "the cover opens again once the page is alive"
