"""What a person sees of a tab, taken from outside of the page: it goes on while the page's script stands still."""

import base64
import time
from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from tests.support.browser.tab import Tab
from tests.support.waiting import eventually

# The script stands still until the service answers; the browser's compositor goes on.
HANG = """setTimeout(() => {
  const call = new XMLHttpRequest();
  call.open('GET', '/hang', false);
  call.send();
}, 0)"""
RESTART_S = 1.0
Share = Callable[[npt.NDArray[np.int_]], float]


class Screencast:
    """The newest picture of the tab, and a share of its pixels that a test looks at."""

    def __init__(self, tab: Tab, share: Share) -> None:
        self._share = share
        self._page = tab.page
        self._session = tab.page.context.new_cdp_session(tab.page)
        self._unanswered: list[int] = []
        self._newest = b""
        self._came_s = time.monotonic()
        self._session.on("Page.screencastFrame", self._keep)
        self._start()

    def _start(self) -> None:
        self._came_s = time.monotonic()
        self._session.send("Page.startScreencast", {"format": "png", "everyNthFrame": 1})

    def _keep(self, event: dict[str, object]) -> None:
        self._newest = base64.b64decode(str(event["data"]))
        self._unanswered.append(int(str(event["sessionId"])))
        self._came_s = time.monotonic()

    def await_share(self, is_so: Callable[[float], bool], detail: str) -> None:
        """Wait until the share is so."""
        eventually(lambda: self._goes_on() and is_so(self.share()), detail=lambda: detail)

    def watch(self, seconds: float) -> None:
        """Take pictures for some time."""
        deadline_s = time.monotonic() + seconds
        while time.monotonic() < deadline_s:
            self._goes_on()

    def _goes_on(self) -> bool:
        """Let the next pictures come; return whether there was one.

        The browser drops a picture that comes before the last one is acknowledged. Where that was the last change, no
        further picture follows: restarting the screencast sends the present one.
        """
        if time.monotonic() - self._came_s > RESTART_S:
            self._session.send("Page.stopScreencast")
            self._start()
        while self._unanswered:
            self._session.send("Page.screencastFrameAck", {"sessionId": self._unanswered.pop()})
        self._page.wait_for_timeout(20)
        return self._newest != b""

    def share(self) -> float:
        """Return the share of the newest picture: rows, columns, and blue, green, red."""
        picture = cv2.imdecode(np.frombuffer(self._newest, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        return self._share(picture.astype(int))
