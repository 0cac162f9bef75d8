"""A page whose script hangs does not stay green: the cover over the gate closes in the browser's own compositor."""

import base64
import time
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from tests.support.browser.fake_service import FakeService, sample
from tests.support.browser.tab import Tab
from tests.support.waiting import eventually

pytestmark = pytest.mark.browser

# The script stands still until the service answers; the browser's compositor goes on.
HANG = """setTimeout(() => {
  const call = new XMLHttpRequest();
  call.open('GET', '/hang', false);
  call.send();
}, 0)"""


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

    def await_green(self, is_so: Callable[[float], bool], detail: str) -> None:
        """Wait until the gate panel's green share is so."""
        eventually(lambda: self._goes_on() and is_so(self.green_share()), detail=lambda: detail)

    def watch(self, seconds: float) -> None:
        deadline_s = time.monotonic() + seconds
        while time.monotonic() < deadline_s:
            self._goes_on()

    def _goes_on(self) -> bool:
        """Let the next pictures come; return whether there was one."""
        while self._unanswered:
            self._session.send("Page.screencastFrameAck", {"sessionId": self._unanswered.pop()})
        self._page.wait_for_timeout(20)
        return self._newest != b""

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
    screen.await_green(lambda share: share > 0.7, "the gate is not shown")
    fake.is_hung.set()
    try:
        tab.page.evaluate(HANG)
        screen.await_green(lambda share: share < 0.01, "the cover does not close")
        screen.watch(1.0)
        assert screen.green_share() < 0.01, "it stays closed"
    finally:
        fake.is_hung.clear()
    tab.sees("beam_on")
    screen.await_green(lambda share: share > 0.7, "the cover does not open again once the page is alive")
